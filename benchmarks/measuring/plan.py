"""Which benchmarks are run, and by which arguments.

Every script in the folder is run, those that have no row here without arguments. A row is a run
whose arguments are others than the script's own, or one of several runs of a script.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

TIMEOUT_S = 1800.0


@dataclass(frozen=True)
class Run:
    """One run of a script.

    Attributes:
        script: file in the folder of the benchmarks.
        full: arguments for figures that are told.
        quick: those of a short pass, whose figures say that all still works.
        timeout_s: after which it is ended [s].
    """

    script: str
    full: tuple[str, ...] = ()
    quick: tuple[str, ...] = ()
    timeout_s: float = TIMEOUT_S


def row(
    script: str, full: str = "", quick: str = "", timeout_s: float = TIMEOUT_S
) -> Run:
    """Arguments as one would type them."""
    return Run(f"{script}.py", tuple(full.split()), tuple(quick.split()), timeout_s)


HOUR = 3600.0
CAMPAIGNS = "../test/campaigns/"
"""Some campaigns give figures for the tables."""
SHIPPED = ("ackermann", "differential", "mecanum", "jackal")
RUNS: dict[str, Run] = {
    "barn": row("barn", "", "--policy straight", HOUR),
    "barn_five_fold": row("barn", "--five-fold", "--policy straight", 3 * HOUR),
    "barn_mujoco": row(
        "barn", "--in mujoco_dds --policy jackal", "--policy straight", HOUR
    ),
    "baselines": row("baselines", "--episodes 200", "--episodes 20"),
    "env_scaling": row("env_scaling", "", "--ends-only --repeats 5"),
    "env_throughput": row("env_throughput", "", "--worlds 256 --repeats 2"),
    **{
        f"env_throughput_{name}": row(
            "env_throughput",
            f"--lidar {lidar}",
            f"--lidar {lidar} --worlds 256 --repeats 2",
        )
        for name, lidar in (
            ("lidar", "hokuyo_ust_10lx"),
            ("rplidar", "rplidar_a2"),
            ("sick", "sick_tim571"),
        )
    },
    "env_throughput_obstacles": row(
        "env_throughput", "--obstacles 260", "--obstacles 260 --worlds 256 --repeats 2"
    ),
    "estimator": row("estimator", "", "--drives 5 --steps 20000"),
    "fig4_pointcloud": row("fig4_pointcloud", "", "--scans 12 --without-slam"),
    "files": row(
        CAMPAIGNS + "files", "", "--kills 5 --flips 20 --cuts 10 --changes 20"
    ),
    "first_hour": row("first_hour", "", "--roads recording", HOUR),
    "unknown_robot": row("unknown_robot", "--minutes 120", "--goals 3", 4 * HOUR),
    "gate_held": row("gate_held", "", "--hours 0.1 --holds 13", 2 * HOUR),
    "gate_envelope": row(
        CAMPAIGNS + "gate_envelope", "--steps 1000000", "--steps 5000"
    ),
    "gate_faults": row(
        CAMPAIGNS + "gate_faults", "--load 2 --repeats 100", "--repeats 1", 4 * HOUR
    ),
    "gate_rules": row(CAMPAIGNS + "gate_rules", timeout_s=2 * HOUR),
    "generate_from_mujoco": row(
        "generate_from_mujoco", "", "--drives 1 --train 30", HOUR
    ),
    "lidar_complexity": row("lidar_complexity", "", "--most 16 --scans 64 --repeats 5"),
    "lidar_peers": row("lidar_peers", "", "--scans 128 --scenes 5 --repeats 2"),
    "node_endings": row(
        CAMPAIGNS + "node_endings", "", "--times 1 --phases starting running", HOUR
    ),
    "node_first_lines": row(
        CAMPAIGNS + "node_endings", "--loops 0 --phases starting", "--loops 0 --times 1"
    ),
    "packet_loss": row(CAMPAIGNS + "packet_loss", "", "--seconds 5"),
    "paper_fig7": row("paper_fig7", "", "--episodes 1"),
    "parity": row(CAMPAIGNS + "parity", "", "--steps 50"),
    "real_drives": row("real_drives", "", "--only xtark_random_drive_45s", HOUR),
    "ros_fleet": row(CAMPAIGNS + "ros_fleet", "", "--seconds 2 --robots 2"),
    "ros_lockstep": row("ros_lockstep", "", "--chunks 5 --size 20"),
    "shield": row(CAMPAIGNS + "shield", "--episodes 3000", "--episodes 30", 2 * HOUR),
    "soak": row(CAMPAIGNS + "soak", "", "--minutes 0.2 --warm-up 0.1"),
    "soak_env": row(CAMPAIGNS + "soak_env", "", "--steps 200000"),
    "standards": row(CAMPAIGNS + "standards", "", "--parts leapp", HOUR),
    **{
        f"table2_{name}": row(
            "table2_lidar", lidar, f"{lidar} --scans 512 --repeats 5".strip()
        )
        for name, lidar in (("lidar", ""), ("hokuyo", "--lidar hokuyo_ust_10lx"))
    },
    "table3_density": row("table3_density", "", "--scans 256"),
    **{
        f"training_{robot}{name}": row(
            "training",
            f"--robot {robot}{lidar} --seeds 0 1 2",
            f"--robot {robot}{lidar} --episodes 50",
        )
        for name, lidar in (("", ""), ("_rplidar", " --lidar rplidar_a2"))
        for robot in ("differential", "ackermann", "mecanum")
    },
    **{
        f"robustness_{robot}": row(
            "robustness",
            f"--robots {robot}",
            f"--robots {robot} --episodes 2 --worlds circles --only drift",
            2 * HOUR,
        )
        for robot in SHIPPED
    },
    **{
        f"transfer_{robot}": row(
            "transfer",
            f"--robots {robot}",
            f"--robots {robot} --episodes 3 --worlds circles doorway",
            2 * HOUR,
        )
        for robot in SHIPPED
    },
}


def runs_of(folder: Path) -> dict[str, Run]:
    """Every run of the scripts in a folder, by name."""
    found: dict[str, Run] = {}
    for path in sorted(folder.glob("*.py")):
        rows = {name: run for name, run in RUNS.items() if run.script == path.name}
        found.update(rows or {path.stem: Run(path.name)})
    for name, run in RUNS.items():
        if run.script.startswith(CAMPAIGNS) and (folder / run.script).exists():
            found[name] = run
    return found
