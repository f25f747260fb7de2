"""Settings of job submission: values only. None of them changes a result, so none is part of a key."""

from __future__ import annotations

from dataclasses import dataclass, field


@dataclass(frozen=True)
class LauncherConfig:
    """What a Slurm job asks for, and what happens when it is stopped.

    Attributes:
        partition: where to queue; empty takes the cluster's default, as for `account`, `qos` and `constraint`.
        account: whom to charge.
        qos: quality of service.
        constraint: features that a node must have.
        nodes: nodes of one teacher; every other job takes one node.
        gpus: GPUs a node, for stages that use them.
        processes: processes a node of one teacher, each with a share of `teacher.num_envs`; 0 means one a GPU, or one.
        cpus: cores a process.
        mem: memory a node, GB; 0 takes the cluster's default.
        time: limit, minutes. A job that reaches it saves its state, queues again and goes on.
        grace: seconds before the limit at which a job is told to stop. One training iteration should fit in, and where
            jobs are preempted it must not exceed the partition's GraceTime by much.
        shards: rollout shards that one job makes.
        parallel: jobs of one array that run at the same time, at most.
        retries: how often a job starts again after a crash (a killed process, no memory); preemption, time limits and
            lost nodes do not count.
        folder: receives a folder for each submission; every node must see it under the same name.
        python: command that starts Python on a node, such as `apptainer exec --nv wbm.sif python`; empty takes the one
            that submits.
        setup: shell lines that run first, such as `module load cuda`.
        extra: further sbatch options without dashes, such as `{mail-type: END}`.
        poll: seconds between looks at the queue while waiting.
    """

    partition: str = ""
    account: str = ""
    qos: str = ""
    constraint: str = ""
    nodes: int = 1
    gpus: int = 0
    processes: int = 0
    cpus: int = 2
    mem: float = 0.0
    time: int = 240
    grace: int = 90
    shards: int = 1
    parallel: int = 256
    retries: int = 2
    folder: str = "jobs"
    python: str = ""
    setup: tuple[str, ...] = ()
    extra: dict[str, str] = field(default_factory=dict)
    poll: float = 5.0

    def __post_init__(self) -> None:
        for name in ("nodes", "cpus", "time", "grace", "shards", "parallel"):
            if getattr(self, name) < 1:
                raise ValueError(f"launcher.{name} must be at least 1, not {getattr(self, name)}")
        for name in ("gpus", "processes", "mem", "retries"):
            if getattr(self, name) < 0:
                raise ValueError(f"launcher.{name} cannot be negative: {getattr(self, name)}")
        if not self.poll > 0:
            raise ValueError(f"launcher.poll must be positive, not {self.poll}")
        if self.grace >= 60 * self.time:
            raise ValueError(f"launcher.grace ({self.grace} s) must be shorter than launcher.time ({self.time} min)")
        if not self.folder:
            raise ValueError("launcher.folder is empty; give a directory that every node sees")

    def processes_per_node(self, gpus: int) -> int:
        """Processes of one teacher on a node that has `gpus`."""
        return self.processes or max(1, gpus)
