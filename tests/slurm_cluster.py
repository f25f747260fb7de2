"""A real Slurm of three nodes on this machine, for tests: munge, one controller, three node daemons, on 127.0.0.1 only.

`python tests/slurm_cluster.py` starts one, says how to use it, and runs until it is interrupted. As root, with
`slurm-wlm` and `munge` installed; no systemd, no cgroups.
"""

from __future__ import annotations

import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from pathlib import Path

NODES = ("n1", "n2", "n3")
# Preemption by partition: a job in `high` takes the place of one in `low`, which hears SIGUSR2 and has GraceTime.
CONFIG = """\
ClusterName=wbmtests
SlurmctldHost={host}(127.0.0.1)
SlurmUser=root
SlurmdUser=root
SlurmctldPort={port}
AuthType=auth/munge
CredType=cred/munge
AuthInfo=socket={state}/munge/munge.sock,cred_expire=5
CommunicationParameters=NoInAddrAny,NoCtldInAddrAny
StateSaveLocation={state}/controller
SlurmdSpoolDir={state}/%n
SlurmctldPidFile={state}/controller.pid
SlurmdPidFile={state}/%n.pid
SlurmctldLogFile={state}/controller.log
SlurmdLogFile={state}/%n.log
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
JobAcctGatherType=jobacct_gather/none
AccountingStorageType=accounting_storage/none
JobCompType=jobcomp/none
MpiDefault=none
SwitchType=switch/none
SelectType=select/cons_tres
SelectTypeParameters=CR_Core
SlurmdParameters=config_overrides
SchedulerType=sched/backfill
SchedulerParameters=sched_interval=1,bf_interval=1,batch_sched_delay=0,sched_min_interval=100000
SlurmctldParameters=preempt_send_user_signal
PreemptType=preempt/partition_prio
PreemptMode=REQUEUE
PreemptExemptTime=0
JobRequeue=1
ReturnToService=2
KillWait=3
MinJobAge=300
InactiveLimit=0
SlurmdTimeout=8
NodeName=n[1-3] NodeHostname={host} NodeAddr=127.0.0.1 Port=[{first}-{last}] CPUs=4 RealMemory=4000 State=UNKNOWN
PartitionName=low Nodes=n[1-3] Default=YES MaxTime=INFINITE State=UP PriorityTier=1 PreemptMode=REQUEUE GraceTime=8
PartitionName=high Nodes=n[1-3] Default=NO MaxTime=INFINITE State=UP PriorityTier=10 PreemptMode=OFF
"""


def unavailable() -> str:
    """Why no Slurm can be started here; empty when one can."""
    missing = [name for name in ("munged", "slurmctld", "slurmd", "sbatch") if not shutil.which(name)]
    if missing:
        return f"{missing[0]} is not installed (apt-get install slurm-wlm munge)"
    return "" if os.geteuid() == 0 else "starting Slurm's daemons needs root"


class SlurmCluster:
    """Starts with the `with` block and ends with it.

    Attributes:
        folder: holds configuration, state and logs; every user must be able to enter it, or munge will not start.
        env: environment in which the commands of Slurm, and `wbm`, use this cluster.
    """

    def __init__(self) -> None:
        self.folder = folder = Path(tempfile.mkdtemp(prefix="wbm-slurm-", dir="/tmp"))
        self.env = {**os.environ, "SLURM_CONF": str(folder / "slurm.conf")}
        for name in [name for name in self.env if name.startswith("SLURM_") and name != "SLURM_CONF"]:
            del self.env[name]

    def __enter__(self) -> SlurmCluster:
        try:
            self._start()
        except BaseException:
            self.__exit__()
            raise
        return self

    def _start(self) -> None:
        for name in ("munge", "controller", *NODES):
            (self.folder / name).mkdir(parents=True, exist_ok=True)
        for path in (self.folder, self.folder / "munge"):
            path.chmod(0o755)
        ports = _free_ports(1 + len(NODES))
        text = CONFIG.format(
            host=socket.gethostname().split(".")[0], state=self.folder, port=ports[0], first=ports[1], last=ports[-1]
        )
        (self.folder / "slurm.conf").write_text(text)
        self._start_munge()
        self.start_controller(clean=True)
        for node in NODES:
            self.start_node(node)
        self.wait_for(
            lambda: {*NODES} == {*self.run("sinfo", "-h", "-N", "-t", "idle", "-o", "%N").split()}, "idle nodes"
        )

    def __exit__(self, *_: object) -> None:
        for node in NODES:
            self.kill_node(node)
        self.kill_controller()
        _kill(_pid(self.folder / "munge" / "munged.pid"), signal.SIGKILL)
        shutil.rmtree(self.folder, ignore_errors=True)

    def run(self, *command: str, check: bool = True) -> str:
        """Output of a command against this cluster."""
        done = subprocess.run(command, env=self.env, capture_output=True, text=True, timeout=300)
        if check and done.returncode:
            raise RuntimeError(f"{' '.join(command)}: {done.stderr}")
        return done.stdout

    def wait_for(self, condition, what: str, limit_s: float = 60.0) -> None:
        """Poll until a condition holds.

        Raises:
            TimeoutError: it did not.
        """
        end = time.monotonic() + limit_s
        while True:
            try:
                if condition():
                    return
            except RuntimeError:
                pass  # the controller may be starting
            if time.monotonic() > end:
                raise TimeoutError(f"{what}: not within {limit_s:.0f} s; see {self.folder}")
            time.sleep(0.2)

    # The daemons

    def _start_munge(self) -> None:
        place = self.folder / "munge"
        (place / "munge.key").write_bytes(os.urandom(1024))
        (place / "munge.key").chmod(0o600)
        files = {"socket": "sock", "log-file": "log", "pid-file": "pid", "seed-file": "seed"}
        paths = [f"--{flag}={place}/munge{'' if ending == 'sock' else 'd'}.{ending}" for flag, ending in files.items()]
        self.run("munged", f"--key-file={place}/munge.key", "--num-threads=2", *paths)

    def start_controller(self, clean: bool = False) -> None:
        """Start the controller: with its saved state, or `clean`."""
        subprocess.run(["slurmctld", *(["-c", "-i"] if clean else [])], env=self.env, check=True, capture_output=True)

    def kill_controller(self) -> None:
        """Kill the controller as a power cut would."""
        _kill(_pid(self.folder / "controller.pid"), signal.SIGKILL)

    def start_node(self, node: str) -> None:
        """Start a node's daemon."""
        subprocess.run(["slurmd", "-N", node], env=self.env, check=True, capture_output=True)

    def kill_node(self, node: str) -> None:
        """Kill a node: its daemon and every process of its jobs, at once."""
        doomed = [_pid(self.folder / f"{node}.pid"), *self._steps(node)]
        for pid in doomed:
            _kill(pid, signal.SIGSTOP)  # nobody may report the others' death
        for pid in [*_descendants(doomed), *doomed]:
            _kill(pid, signal.SIGKILL)

    def _steps(self, node: str) -> list[int]:
        """Step daemons of a node: those that listen on a socket in its spool folder."""
        rows = [line.split() for line in Path("/proc/net/unix").read_text().splitlines()[1:]]
        sockets = {f"socket:[{row[6]}]" for row in rows if row[-1].startswith(f"{self.folder}/{node}/")}
        found = []
        for path in Path("/proc").glob("[0-9]*/fd"):
            try:
                if sockets & {os.readlink(handle) for handle in path.iterdir()}:
                    found.append(int(path.parent.name))
            except OSError:
                continue  # it ended meanwhile
        return found


def _pid(path: Path) -> int | None:
    try:
        return int(path.read_text())
    except (OSError, ValueError):
        return None


def _kill(pid: int | None, number: int) -> None:
    if pid:
        try:
            os.kill(pid, number)
        except ProcessLookupError:
            return


def _descendants(roots: list[int | None]) -> list[int]:
    """Processes below `roots`, the deepest first."""
    children: dict[int, list[int]] = {}
    for path in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = path.read_text().rsplit(")", 1)[1].split()
        except OSError:
            continue
        children.setdefault(int(fields[1]), []).append(int(path.parent.name))
    found: list[int] = []
    todo = [pid for pid in roots if pid]
    while todo:
        below = children.get(todo.pop(), [])
        found += below
        todo += below
    return found[::-1]


def _free_ports(count: int) -> list[int]:
    """The first of consecutive ports that are free on 127.0.0.1."""
    for first in range(20000 + os.getpid() % 400 * 100, 64000, 50):
        ports = list(range(first, first + count))
        sockets = [socket.socket() for _ in ports]
        try:
            for port, s in zip(ports, sockets, strict=True):
                s.bind(("127.0.0.1", port))
            return ports
        except OSError:
            continue
        finally:
            for s in sockets:
                s.close()
    raise OSError("no free ports")


def main() -> None:
    reason = unavailable()
    if reason:
        sys.exit(reason)
    with SlurmCluster() as cluster:
        print(f"export SLURM_CONF={cluster.env['SLURM_CONF']}\n{cluster.run('sinfo')}", flush=True)
        signal.signal(signal.SIGTERM, lambda *_: sys.exit())
        signal.pause()


if __name__ == "__main__":
    main()
