"""The root of the configuration: one frozen dataclass, a field for each section.

A section's dataclass lives beside its consumer in a module without heavy imports (no torch, warp or mujoco), so that
`wbm plan` stays fast. Adding a section is an import, a field, and, where it has presets, a group in `conf/`.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from wbm.artifacts.config import ArtifactsConfig
from wbm.control.config import WbcConfig
from wbm.deploy.config import DeployConfig
from wbm.envs.config import EnvConfig
from wbm.envs.rollout_config import RolloutsConfig
from wbm.launch.config import LauncherConfig
from wbm.learning.config import PpoConfig, TeacherConfig
from wbm.learning.figure4_config import Figure4Config
from wbm.learning.student_config import DistillConfig, StudentConfig
from wbm.report.config import EvaluationConfig
from wbm.robot.config import MjcfOptions
from wbm.scenes.config import ObjectsConfig, ScenesConfig
from wbm.sensors.config import SensorsConfig
from wbm.sim.config import SimConfig


@dataclass(frozen=True)
class Config:
    """Everything that can be set on the command line.

    Attributes:
        seed: the seed from which all others derive.
        note: free text for the manifest; never part of a key.
        policy: what to evaluate or export, as `kind/name[/key]` or `reference[/name]`; default: the student.
        inputs: input slot -> artifact to use in place of the newest one; `teacher_NAME` is one teacher of the suite.
        teachers: the suite: names of presets in `conf/teacher/`.

    The other attributes are the sections; their dataclasses document them.
    """

    seed: int = 0
    note: str | None = None
    policy: str | None = None
    inputs: dict[str, str] = field(default_factory=dict)
    teachers: tuple[str, ...] = ("top_down", "side")
    artifacts: ArtifactsConfig = field(default_factory=ArtifactsConfig)
    launcher: LauncherConfig = field(default_factory=LauncherConfig)
    robot: MjcfOptions = field(default_factory=MjcfOptions)
    wbc: WbcConfig = field(default_factory=WbcConfig)
    objects: ObjectsConfig = field(default_factory=ObjectsConfig)
    scenes: ScenesConfig = field(default_factory=ScenesConfig)
    sim: SimConfig = field(default_factory=SimConfig)
    sensors: SensorsConfig = field(default_factory=SensorsConfig)
    env: EnvConfig = field(default_factory=EnvConfig)
    teacher: TeacherConfig = field(default_factory=TeacherConfig)
    ppo: PpoConfig = field(default_factory=PpoConfig)
    rollouts: RolloutsConfig = field(default_factory=RolloutsConfig)
    student: StudentConfig = field(default_factory=StudentConfig)
    distill: DistillConfig = field(default_factory=DistillConfig)
    evaluation: EvaluationConfig = field(default_factory=EvaluationConfig)
    figure4: Figure4Config = field(default_factory=Figure4Config)
    deploy: DeployConfig = field(default_factory=DeployConfig)
