"""Which benchmarks are run, and by which arguments.

`make benchmark` takes half an hour on two cores. `LONG=1` takes hours and gives the figures of the
tables; where a row has no arguments for it, they are the same. Scripts without a row are run
without arguments. Some campaigns give figures, too; they run in their folder.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

CAMPAIGNS = "../test/campaigns/"
LONG_TIMEOUT_S = 4 * 3600.0


@dataclass(frozen=True)
class Run:
    """One run of a script.

    Attributes:
        script: its file, from the folder of the benchmarks.
        arguments: within half an hour for all runs.
        long: those of the long version.
        timeout_s: after which a run is ended [s].
    """

    script: str
    arguments: tuple[str, ...] = ()
    long: tuple[str, ...] = ()
    timeout_s: float = 600.0
    long_timeout_s: float = LONG_TIMEOUT_S


def make_run(script: str, arguments: str = "", long: str | None = None) -> Run:
    """Arguments as one would type them."""
    words = tuple(arguments.split())
    return Run(f"{script}.py", words, words if long is None else tuple(long.split()))


LEARNERS = ("differential", "ackermann", "mecanum")
SHIPPED = (*LEARNERS, "jackal")
LIDARS = {
    "lidar": "hokuyo_ust_10lx",
    "rplidar": "rplidar_a2",
    "sick": "sick_tim571",
}
RUNS: dict[str, Run] = {
    "barn": make_run("barn", "--every 5", ""),
    "barn_five_fold": make_run("barn", "--five-fold --folds 1", "--five-fold"),
    "barn_mujoco": make_run("barn", "--in mujoco_dds --policy jackal"),
    "baselines": make_run("baselines", "--episodes 50", "--episodes 200"),
    "env_scaling": make_run("env_scaling"),
    "env_throughput": make_run("env_throughput", "--repeats 3", ""),
    **{
        f"env_throughput_{name}": make_run(
            "env_throughput", f"--lidar {lidar} --repeats 3", f"--lidar {lidar}"
        )
        for name, lidar in LIDARS.items()
    },
    "env_throughput_obstacles": make_run(
        "env_throughput", "--obstacles 260 --repeats 3", "--obstacles 260"
    ),
    "estimator": make_run("estimator", "--drives 30", ""),
    "fig4_pointcloud": make_run("fig4_pointcloud", "--scans 60", ""),
    "first_hour": make_run("first_hour"),
    "gate_envelope": make_run(
        CAMPAIGNS + "gate_envelope", "--steps 30000", "--steps 1000000"
    ),
    "gate_faults": make_run(
        CAMPAIGNS + "gate_faults", "--repeats 1", "--load 2 --repeats 100"
    ),
    "generate_from_mujoco": make_run("generate_from_mujoco", "--drives 3", ""),
    "lidar_complexity": make_run("lidar_complexity", "--repeats 20", ""),
    "lidar_peers": make_run("lidar_peers"),
    "paper_fig7": make_run("paper_fig7", "--episodes 1", ""),
    "parity": make_run(CAMPAIGNS + "parity"),
    "ros_lockstep": make_run("ros_lockstep", "--chunks 40", ""),
    "shield": make_run(
        CAMPAIGNS + "shield", "--in-process --episodes 300", "--episodes 3000"
    ),
    "standards": make_run(CAMPAIGNS + "standards", "--chunks 10", ""),
    "table2_lidar": make_run("table2_lidar"),
    "table2_hokuyo": make_run("table2_lidar", "--lidar hokuyo_ust_10lx"),
    **{
        f"training_{robot}{name}": make_run(
            "training",
            f"--robot {robot}{lidar} --seeds 0",
            f"--robot {robot}{lidar} --seeds 0 1 2",
        )
        for name, lidar in (("", ""), ("_rplidar", " --lidar rplidar_a2"))
        for robot in LEARNERS
    },
    **{
        f"robustness_{robot}": make_run(
            "robustness", f"--robots {robot} --episodes 1", f"--robots {robot}"
        )
        for robot in SHIPPED
    },
    **{
        f"transfer_{robot}": make_run(
            "transfer", f"--robots {robot} --episodes 3", f"--robots {robot}"
        )
        for robot in SHIPPED
    },
}


NO_SCRIPTS = ("bench.py", "figures.py", "plan.py", "tables.py")


def plan_of(folder: Path) -> dict[str, Run]:
    """Every run of the scripts in a folder, by name."""
    found: dict[str, Run] = {}
    for path in sorted(folder.glob("*.py")):
        rows = {name: run for name, run in RUNS.items() if run.script == path.name}
        if path.name not in NO_SCRIPTS:
            found.update(rows or {path.stem: Run(path.name)})
    for name, run in RUNS.items():
        if run.script.startswith(CAMPAIGNS) and (folder / run.script).exists():
            found[name] = run
    return found
