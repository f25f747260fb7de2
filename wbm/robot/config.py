"""Settings of the robot and its physics model: values only."""

from __future__ import annotations

from dataclasses import dataclass, field

SKINS = ("primitives", "menagerie")


@dataclass(frozen=True)
class MjcfOptions:
    """How the robot becomes MJCF.

    Attributes:
        arm_armature_extra: added to the published armature of the seven arm joints, kg m^2. The published 0.1 with
            stiff position gains and force limits falls into a limit cycle at 10 ms steps: torques chatter at their
            limits and the arm freezes.
        hand_effort: force limit of the hand's actuators, N m; 0 keeps the model's.
        self_collision: whether links of arm, neck and base may touch each other and the hand.
        skin: `primitives`, or `menagerie` for the published meshes as visuals in exported files.
        facts: a YAML file that is laid over the standard facts: another arm, hand, mounting or limits. Its content,
            not its place, decides whether assets are up to date; later stages take the robot from the assets.
    """

    arm_armature_extra: float = 2.0
    hand_effort: float = 0.0
    self_collision: bool = True
    skin: str = "primitives"
    facts: str = field(default="", metadata={"key": False})

    def __post_init__(self) -> None:
        if self.arm_armature_extra < 0 or self.hand_effort < 0:
            raise ValueError("robot: arm_armature_extra and hand_effort must not be negative")
        if self.skin not in SKINS:
            raise ValueError(f"robot.skin={self.skin}: use {' or '.join(SKINS)}")
        if self.skin != "primitives" and self.facts:
            raise ValueError(
                f"robot.skin={self.skin} shows the standard parts: it cannot dress robot.facts={self.facts}"
            )
