"""Every table of figures in README.md and docs/: a row for each figure, filled in by `make tables`.

What stands between `<!-- results:NAME -->` and `<!-- /results -->` is the table `NAME`. A cell is
text with placeholders, `{[REDUCTION ][RUN:]PATH[ xFACTOR][|FORMAT]}`, with a reduction of max,
min, sum, mean and harmonic_mean. The path goes into the result of the row's run, or of `RUN`, with
dots between keys and `*` for each; the format is Python's. A cell whose placeholders lead nowhere
reads `not measured`.
"""

from __future__ import annotations

import re
import sys
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from statistics import harmonic_mean, mean
from textwrap import shorten
from typing import Any

from bench import MET, RESULTS, ROOT, RUNS, read_results

PLACEHOLDER = re.compile(
    r"\{(?:(?P<how>max|min|sum|mean|harmonic_mean) )?(?:(?P<run>[a-z0-9_]+):)?(?P<path>[^{}|]+?)"
    r"(?: x(?P<factor>[0-9.e+-]+))?(?:\|(?P<format>[^{}]*))?\}"
)
"""A figure in a cell: a path into the result of a run, by default that of the row."""


@dataclass(frozen=True)
class Table:
    """A table of figures, before they are filled in.

    Attributes:
        head: its columns.
        rows: the run that a row is of, and its cells, with placeholders.
        notes: whether the marks are explained below the table.
    """

    head: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    notes: bool = True


def told(*rows: tuple[str, str, str]) -> Table:
    """Figures in words: run, what, figure."""
    return Table(
        ("what", "script", "figure"),
        tuple(
            (
                run,
                what,
                f"`{Path(RUNS[run].script).name if run in RUNS else f'{run}.py'}`",
                text,
            )
            for run, what, text in rows
        ),
    )


ROBOTS = {
    "ackermann": "Ackermann",
    "differential": "differential",
    "mecanum": "mecanum",
}
POLICIES = {**ROBOTS, "jackal": "Jackal"}
WORLDS = (
    "empty",
    "arena",
    "circles",
    "doorway",
    "clutter",
    "corridor",
    "crowd",
    "room",
)
PERTURBATIONS = ("noise", "drop-out", "latency", "response", "drift", "footprint")
FIGURES = told(
    (
        "real_drives",
        "a real car, 5 s open-loop predictions on 11 s segments of a 45 s drive, each held out in "
        "turn",
        "{left_out.xtark_random_drive_45s.error_m|.3f} m and "
        "{left_out.xtark_random_drive_45s.heading_error_rad|.3f} rad over a path of "
        "{left_out.xtark_random_drive_45s.path_m|.2f} m",
    ),
    (
        "env_throughput",
        "env steps per second: 720 beams, 10 circles, observation, reward, autoreset",
        "{single_thread_env_steps_per_s|.1e} on one thread, {all_threads_env_steps_per_s|.1e} on "
        "{threads}; {single_env_gym_steps_per_s|.1e} by `gymnasium.make`, "
        "{single_env_with_estimator_steps_per_s|.1e} with the estimator",
    ),
    (
        "env_throughput_obstacles",
        "the same on one thread among 260 circles instead of ten, as dense",
        "{single_thread_env_steps_per_s|.1e}, {share_of_usual|.0%} of ten circles' in that run",
    ),
    (
        "parity",
        "in process against DDS lock-step, three robots, and four in namespaces",
        "difference {max_abs_observation_difference|.2g}, {late_observations} late observations in "
        "{steps|,} steps",
    ),
    (
        "standards",
        "simulation_interfaces (conformance of what is announced), a Nav2 stand-in, LEAPP's own "
        "runner",
        "{sim_features} features, {sim_conformance_failed} failed; {follow_path_success|.0%} of "
        "the planned paths driven; actions differ by {leapp_max_abs_difference|.1g}",
    ),
    (
        "ros_lockstep",
        "env steps over DDS in lock-step, 720 beams, estimator included",
        "{steps_per_s|,.0f} per second, median {p50_ms|.2f} ms; a bare pair of rclpy nodes "
        "exchanges the same messages {bare_echo_per_s|,.0f} times",
    ),
    (
        "first_hour",
        "what a new user waits for from a clean clone on: the first picture; a policy of a Burger "
        "by its YAML file; the report of a recording; a policy of a task of one's own",
        "picture {seconds.picture|.0f} s, {setup_s|.0f} s of them set-up; Burger "
        "{seconds.robot|.0f} s, success {success.robot|.1%}; report {seconds.recording|.0f} s; "
        "own task {seconds.task|.0f} s, success {success.task|.1%}",
    ),
)
XTARK = "drives.xtark_random_drive_45s"
SLIPPERY = "drives.f110_ds1"
FIRST_SCREEN = Table(
    ("", "here", "compared with"),
    (
        (
            "env_throughput",
            "navigation steps per second, one thread, 720 beams, 10 obstacles",
            "{single_thread_env_steps_per_s x1e-3|.0f},000",
            "{times_as_fast_at_equal_work.irsim_x|.0f} times as fast as irsim-x, "
            "{times_as_fast_at_equal_work.ir_sim|,.0f} times ir-sim",
        ),
        (
            "env_throughput_lidar",
            "the same with a Hokuyo UST-10LX: 1,081 noisy beams",
            "{single_thread_env_steps_per_s x1e-3|.0f},000",
            "{times_as_long_as_clean|.2f} times the step time without noise",
        ),
        (
            "training_differential",
            "navigation learned from scratch, worst of three seeds: success, time",
            "; ".join(
                f"{title} {{training_{robot}:success_rate|.1%}}, "
                f"{{training_{robot}:wall_s|.0f}} s"
                for robot, title in ROBOTS.items()
            ),
            "`dynamic_window` planner: "
            + ", ".join(
                f"{{baselines:circles/{robot}/dynamic_window.success.value x100|.1f}}"
                for robot in ROBOTS
            )
            + " %",
        ),
        (
            "barn_five_fold",
            "250 BARN worlds without a map, five-fold cross-validation",
            "{success|.1%} success, {collision|.1%} collisions, score {score|.3f} of 0.5",
            "the planners score: `mppi` {barn:policies.mppi.score|.3f}, `dynamic_window` "
            "{barn:policies.dynamic_window.score|.3f}",
        ),
        (
            "real_drives",
            "eight real drives, predicted 5 s ahead on unseen data: best, worst",
            f"off by {{{XTARK}.share_of_path x100|.1f}} and "
            f"{{{SLIPPERY}.share_of_path|.1%}} of the path",
            f"fitted textbook model {{{XTARK}.yardstick_share x100|.1f}} and "
            f"{{{SLIPPERY}.yardstick_share|.1%}}, constant twist "
            f"{{{XTARK}.constant_twist_share x100|.1f}} and "
            f"{{{SLIPPERY}.constant_twist_share|.1%}}",
        ),
        (
            "transfer_jackal",
            "a Jackal in MuJoCo over ROS 2, eight worlds",
            "{min success.*.*.mujoco_dds x100|.0f} to {max success.*.*.mujoco_dds|.0%} success",
            "the same policy in process: {min success.*.*.fast x100|.0f} to "
            "{max success.*.*.fast|.0%}",
        ),
        (
            "parity",
            "observations over ROS 2 in lock-step, {steps|,} steps",
            "largest difference {max_abs_observation_difference|.2g}",
            "the same steps in process",
        ),
        (
            "shield",
            "contacts with the shield in adversarial episodes",
            "{contacts} in {episodes|,}",
            "without the shield: {contacts_without} in {tried_without}",
        ),
    ),
    notes=False,
)
SAFETY = told(
    (
        "gate_faults",
        "faults around real processes over DDS at 10 Hz: policy killed, frozen, hung, scan and "
        "odom silent, NaN in scans, clocks that jump, e-stop, and more",
        "zero within {scan_silent.max_s|.2f} s of the last scan, {command_silent.max_s|.2f} s of "
        "the last command ({command_frozen.max_s|.2f} s if it is repeated), "
        "{policy_killed.max_s|.2f}, {policy_frozen.max_s|.2f} and {policy_hung.max_s|.2f} s of the "
        "policy's death, freeze or hang ({scan_silent.n} times each), {e_stop.max_s|.2f} s of the "
        "e-stop, {e_stop_silent.max_s|.2f} s of its last heartbeat; {sum *.unsafe_commands} unsafe "
        "commands",
    ),
    (
        "gate_envelope",
        "random commands at intervals of 1 to 220 ms, three robots",
        "{violations} violations of value, rate, jerk or zero in {steps|,} commands, in motion at "
        "{in_motion|,} of them",
    ),
    (
        "shield",
        "episodes of adversaries, three robots",
        "{contacts} contacts in {episodes|,} and {path_m x0.001|.1f} km; without the shield "
        "{contacts_without} in {tried_without}",
    ),
)
THROUGHPUT = Table(
    ("", "ir-sim 2.12.0", "irsim-x 1.1.4"),
    tuple(
        (
            "env_throughput",
            title,
            *(f"{{{path.format(name)}}}" for name in ("ir_sim", "irsim_x")),
        )
        for title, path in (
            (
                "one thread is as fast, at equal work: one scan per control period",
                "times_as_fast_at_equal_work.{}|,.0f",
            ),
            (
                "one thread is as fast, with ten of their own steps per control period",
                "times_as_fast_with_ten_scans.{}|,.0f",
            ),
            ("a scan alone [ms]", "peer_readings.{}.scan_s x1000|.3g"),
            (
                "a scan within their step [ms]",
                "peer_readings.{}.scan_within_step_s x1000|.3g",
            ),
            (
                "their step, a motion and a scan [ms]",
                "peer_readings.{}.step_s x1000|.3g",
            ),
            (
                "control period with one scan [ms]",
                "peer_readings.{}.period_with_one_scan_s x1000|.3g",
            ),
            (
                "control period with ten scans [ms]",
                "peer_readings.{}.period_with_ten_scans_s x1000|.3g",
            ),
        )
    ),
)
REAL_LIDARS = Table(
    (
        "lidar",
        "env steps per second, one thread",
        "of the usual env's",
        "step time, of a copy without faults",
    ),
    tuple(
        (
            f"env_throughput_{run}",
            title,
            "{single_thread_env_steps_per_s|.1e}",
            "{share_of_usual|.0%}",
            "{times_as_long_as_clean|.2f}",
        )
        for run, title in (
            ("lidar", "Hokuyo UST-10LX"),
            ("rplidar", "RPLIDAR A2"),
            ("sick", "SICK TiM571"),
        )
    ),
)
SCALING = Table(
    ("",) * 6,
    tuple(
        (
            "env_scaling",
            title,
            *(f"{{{key}.{k}{how}}}" if k >= 0 else "" for k in indices),
        )
        for sizes, name, key, indices in (
            ("worlds", "µs per env step", "worlds_us", (0, 2, 4, 5, 7)),
            (
                "robots in each world",
                "µs per robot and step",
                "robots_us_per_robot",
                (0, 2, 4, 5, 6),
            ),
            ("obstacles", "µs per env step", "obstacles_us", (0, 1, 2, 3, 4)),
            ("beams", "µs per env step", "beams_us", (0, 2, 4, 5, 6)),
            ("members of the set", "µs per env step", "members_us", (0, 1, 2, 3, -1)),
        )
        for title, key, how in ((sizes, sizes.split()[0], ""), (name, key, "|.1f"))
    ),
)
ESTIMATOR = Table(
    ("robot", "odometry, RMSE [m]", "estimate, RMSE [m]", "mean NEES", "95 % band"),
    tuple(
        (
            "estimator",
            title,
            f"{{{path}raw_rmse_m|.3f}}",
            f"{{{path}ekf_rmse_m|.3f}}",
            f"{{{path}nees_mean|.2f}}",
            f"{{{path}nees_95_band.0|.2f}} to {{{path}nees_95_band.1|.2f}}",
        )
        for title, path in (
            *((each, f"robots.{each}.") for each in ROBOTS),
            ("all", ""),
        )
    ),
)
TRANSFER = Table(
    ("success [%]: in process, over DDS, MuJoCo", *POLICIES.values()),
    (
        *(
            (
                "transfer_ackermann",
                f"`{world}`",
                *(
                    ", ".join(
                        f"{{transfer_{robot}:success.{robot}.{world}.{place} x100|.0f}}"
                        for place in ("fast", "dds", "mujoco_dds")
                    )
                    for robot in POLICIES
                ),
            )
            for world in WORLDS
        ),
        (
            "transfer_ackermann",
            "collisions [%], at most",
            *(
                f"{{max transfer_{robot}:collision.*.*.* x100|.0f}}"
                for robot in POLICIES
            ),
        ),
    ),
)
ROBUSTNESS = Table(
    (
        "success [%] at 0, 1/2, 1, 2 times the range",
        "declared range",
        *POLICIES.values(),
    ),
    tuple(
        (
            "robustness_differential",
            each,
            f"{{declared.differential.{each}}}",
            *(
                ", ".join(
                    f"{{robustness_{robot}:success.{robot}.{each}.{k} x100|.0f}}"
                    for k in range(4)
                )
                for robot in POLICIES
            ),
        )
        for each in PERTURBATIONS
    ),
)
BASELINES = Table(
    ("`circles`, success", "differential", "ackermann", "mecanum"),
    tuple(
        (
            "baselines",
            f"`{policy}`",
            *(
                f"{{{at}.success.value|.1%}} ({{{at}.success.low x100|.1f}} to "
                f"{{{at}.success.high x100|.1f}}), collision {{{at}.collision.value|.1%}}"
                for at in (
                    f"circles/{robot}/{policy}"
                    for robot in ("differential", "ackermann", "mecanum")
                )
            ),
        )
        for policy in ("dynamic_window", "mppi", "straight", "random")
    ),
)
BARN = Table(
    ("in the 250 worlds", "success", "collision", "time-out", "time", "score"),
    tuple(
        (
            run,
            who,
            *(f"{{{at}{key}|.1%}}" for key in ("success", "collision", "time_out")),
            f"{{{at}time_s|.1f}} s",
            f"{{{at}score|.3f}}",
        )
        for run, at, who in (
            ("barn", "", "the Jackal's policy, which was learnt from them"),
            ("barn_five_fold", "", "learnt from four fifths, in the rest"),
            (
                "barn_mujoco",
                "",
                "the Jackal's policy in MuJoCo over DDS, every tenth world",
            ),
            ("barn", "policies.mppi.", "`mppi`"),
            ("barn", "policies.dynamic_window.", "`dynamic_window`"),
            ("barn", "policies.straight.", "`straight`"),
        )
    ),
)
TRAINING = Table(
    (
        "robot",
        "lidar",
        "success",
        "collision",
        "environment steps",
        "time",
        "steps per second",
    ),
    tuple(
        (
            f"training_{robot}{run}",
            robot,
            lidar,
            "{success_rate|.1%} ({success_95ci.0 x100|.1f} to {success_95ci.1 x100|.1f})",
            "{collision_rate|.1%}",
            "{env_steps|,}",
            "{wall_s|.0f} s",
            "{steps_per_s|,.0f}",
        )
        for run, lidar in (("", "the paper's"), ("_rplidar", "RPLIDAR A2"))
        for robot in ("differential", "mecanum", "ackermann")
    ),
)
MUJOCO = Table(
    ("robot", "error / path, mean", "worst unseen drive", "speed-up, batched", "alone"),
    tuple(
        (
            "generate_from_mujoco",
            title,
            f"{{robots.{robot}.position_error_over_path|.3f}}",
            f"{{robots.{robot}.worst_drive_error_over_path|.3f}}",
            f"{{robots.{robot}.speed_up_batched|.1e}}",
            f"{{robots.{robot}.speed_up_single|.1e}}",
        )
        for robot, title in (*ROBOTS.items(), ("jackal", "Jackal, skid-steer"))
    ),
)
ERRORS = (
    "{%s.error_m|.3f} m",
    "{%s.share_of_path|.1%%}",
    "{%s.yardstick_share|.1%%}",
    "{%s.constant_twist_share|.1%%}",
    "{%s.coverage_95|.0%%}",
)
REAL_DRIVES = Table(
    (
        "drive",
        "error",
        "of the path",
        "fitted textbook",
        "constant twist",
        "95 % band holds",
    ),
    tuple(
        ("real_drives", title, *(each % place for each in ERRORS))
        for title, place in (
            ("XTARK car, 45 s", "drives.xtark_random_drive_45s"),
            ("JetRacer by throttle, up to 5 m/s", "drives.jetracer_free_driving_104s"),
            ("JetRacer by throttle, slow", "drives.jetracer_random_driving_slow_63s"),
            ("F1/10, slippery floor, DS1", "drives.f110_ds1"),
            ("F1/10, slippery floor, DS3", "drives.f110_ds3"),
            ("F1/10, slippery floor, DS4", "drives.f110_ds4"),
            ("differential, ticks, 1", "drives.ticks_01"),
            ("differential, ticks, 2", "drives.ticks_02"),
            ("simulated skid-steer", "own_robots.skid_steer"),
            ("simulated car by throttle", "own_robots.throttle_car"),
            ("simulated tricycle", "own_robots.tricycle"),
            ("simulated tricycle, slewed commands", "own_robots.slewed_tricycle"),
            ("simulated omnidirectional", "own_robots.omni"),
            ("simulated differential, ticks", "own_robots.ticks"),
        )
    ),
)
PAPER_STEPS = {
    "ackermann": ("3.1e-9", "9.7e-6", "9.9e-5", "", "9.0e4", ""),
    "differential": ("2.6e-7", "5.1e-9", "1.6e-16", "", "5.7e4", ""),
    "mecanum": ("1.2e-17", "9.4e-18", "3.8e-17", "", "4.7e4", ""),
}
TABLE1 = Table(
    (
        "robot",
        "",
        "x [m]",
        "y [m]",
        "heading [rad]",
        "terms",
        "steps/s, one robot",
        "steps/s, batched",
    ),
    tuple(
        row
        for robot, title in ROBOTS.items()
        for row in (
            (
                "table1_kinematics",
                title,
                "here",
                *(
                    f"{{robots.{robot}.rmse_{each}|.1e}}"
                    for each in ("x_m", "y_m", "heading_rad")
                ),
                f"{{robots.{robot}.terms_kept}} of {{robots.{robot}.terms_total}}",
                f"{{robots.{robot}.steps_per_s_single|.1e}}",
                f"{{robots.{robot}.steps_per_s_batched|.1e}}",
            ),
            ("table1_kinematics", "", "paper", *PAPER_STEPS[robot]),
        )
    ),
)
SHAPES = {
    "circle": "circle, r 0.15 m",
    "square": "square, 0.3 m",
    "strip": "strip, 0.6 x 0.06 m",
    "mixture": "mixture",
}
LIDAR_PEERS = Table(
    (
        "",
        "scans/s",
        "baked is faster",
        "RMSE against our exact scan",
        "its cost in a step / alone",
    ),
    (
        ("lidar_peers", "baked", "{baked|.1e}", "", "{rmse_m.baked x1000|.1f} mm", ""),
        ("lidar_peers", "exact", "{exact|.1e}", "", "", ""),
        *(
            (
                "lidar_peers",
                title,
                f"{{{name}|,.0f}}",
                f"{{times_as_fast_at_equal_work.{name}|,.0f}} times",
                f"{{rmse_m.{name}|.1g}} m{further}",
                f"{{agreement.{name}|.2f}}",
            )
            for name, title, further in (
                ("ir_sim", "ir-sim 2.12.0", " (its circles are polygons)"),
                ("irsim_x", "irsim-x 1.1.4", ""),
            )
        ),
    ),
)
PAPER_SCANS = {
    "circle": ("57", "330", "0.085", "0.0056"),
    "square": ("3.6", "332", "0.089", "0.0067"),
    "strip": ("4.2", "324", "0.105", "0.0099"),
    "mixture": ("5.7", "339", "0.091", "0.0072"),
}
# The paper's average speeds are harmonic means of its four scenes, its errors arithmetic ones.
PAPER_AVERAGE = ("5.65", "331", "0.0923", "0.00735")
AVERAGE_SCENE = (
    (
        "table2_lidar",
        "average",
        "here",
        "{harmonic_mean scenes.*.exact_scans_per_s|.1e}",
        "{harmonic_mean scenes.*.baked_scans_per_s|.1e}",
        "{mean scenes.*.rmse_m|.4f}",
        "{mean scenes.*.area_rmse_m2|.4f}",
        "{mean scenes.*.share_of_write_limit|.0%}",
        "",
    ),
    (
        "table2_lidar",
        "",
        "nearest row",
        "",
        "",
        "{mean scenes.*.nearest_row_rmse_m|.3f}",
        "{mean scenes.*.nearest_row_area_rmse_m2|.3f}",
        "",
        "",
    ),
    ("table2_lidar", "", "paper", *PAPER_AVERAGE, "", ""),
)
TABLE2 = Table(
    (
        "scene",
        "",
        "scan mode [1/s]",
        "baked [1/s]",
        "RMSE [m]",
        "RMSE of the area [m²]",
        "of the write limit",
        "table",
    ),
    tuple(
        row
        for name, title in SHAPES.items()
        for row in (
            (
                "table2_lidar",
                title,
                "here",
                f"{{scenes.{name}.exact_scans_per_s|.1e}}",
                f"{{scenes.{name}.baked_scans_per_s|.1e}}",
                f"{{scenes.{name}.rmse_m|.4f}}",
                f"{{scenes.{name}.area_rmse_m2|.4f}}",
                f"{{scenes.{name}.share_of_write_limit|.0%}}",
                f"{{table_bytes.{name} x1e-6|.2g}} MB",
            ),
            (
                "table2_lidar",
                "",
                "nearest row",
                "",
                "",
                f"{{scenes.{name}.nearest_row_rmse_m|.3f}}",
                f"{{scenes.{name}.nearest_row_area_rmse_m2|.3f}}",
                "",
                "",
            ),
            ("table2_lidar", "", "paper", *PAPER_SCANS[name], "", ""),
        )
    )
    + AVERAGE_SCENE,
)
TABLE2_HOKUYO = Table(
    (
        "scene",
        "exact [1/s]",
        "baked [1/s]",
        "RMSE [m]",
        "nearest row's",
        "of the write limit",
        "table",
    ),
    tuple(
        (
            "table2_hokuyo",
            title,
            f"{{scenes.{name}.exact_scans_per_s|.1e}}",
            f"{{scenes.{name}.baked_scans_per_s|.1e}}",
            f"{{scenes.{name}.rmse_m|.4f}}",
            f"{{scenes.{name}.nearest_row_rmse_m|.3f}}",
            f"{{scenes.{name}.share_of_write_limit|.0%}}",
            f"{{table_bytes.{name} x1e-6|.2g}} MB",
        )
        for name, title in SHAPES.items()
    ),
)
DENSITIES = ("100x240", "50x240", "100x120")
TABLE3 = Table(
    ("look-up", "distances x rotations", *SHAPES, "worse, on average"),
    (
        *(
            (
                "table3_density",
                title if not k else "",
                density.replace("x", " x "),
                *(f"{{{path}{density}.{name}|{how}}}" for name in SHAPES),
                f"{{times_worse.{key}.{density}|.2f}} times" if k else "",
            )
            for key, title, path, how in (
                ("ours", "here", "", ".4f"),
                ("nearest_row", "nearest row", "nearest_row.", ".3f"),
            )
            for k, density in enumerate(DENSITIES)
        ),
        ("table3_density", "paper", "50 x 240", "", "", "", "", "3.47 times"),
        ("table3_density", "", "100 x 120", "", "", "", "", "little"),
    ),
)
LIDAR_COMPLEXITY = Table(
    ("vertices", *(str(2**power) for power in range(2, 13))),
    tuple(
        ("lidar_complexity", name, *(f"{{{name}_us.{k}|.2g}}" for k in range(11)))
        for name in ("exact", "baked")
    ),
)
MAPS = Table(
    (
        "720 beams, map of 20 m x 20 m at 0.05 m",
        "range [m]",
        "exact [scans/s]",
        "baked [scans/s]",
        "ratio",
        "RMSE [mm]",
    ),
    tuple(
        (
            "map_lidar",
            title,
            f"{{rows.{k}.range_max_m|.0f}}",
            f"{{rows.{k}.exact_scans_per_s|,}}",
            f"{{rows.{k}.baked_scans_per_s|,}}",
            f"{{rows.{k}.ratio|.1f}}",
            f"{{rows.{k}.rmse_m x1000|.1g}}",
        )
        for k, title in enumerate((*("office",) * 2, *("as SLAM leaves it",) * 2))
    ),
)
FIG4 = Table(
    ("", "against scan mode", "[mm]"),
    (
        *(
            ("fig4_pointcloud", title, what, f"{{{path} x1000|{how}}}")
            for title, key, how in (
                ("baked", "baked", ".1f"),
                ("MuJoCo", "mujoco", ".1g"),
            )
            for what, path in (
                ("RMSE of the cloud, to the nearest point", f"cloud_rmse_m.{key}"),
                ("RMSE beam by beam", f"range_rmse_m.{key}"),
            )
        ),
        (
            "fig4_pointcloud",
            "odometry",
            "error of the path",
            "{slam.odometry_error_m x1000|.0f}",
        ),
        (
            "fig4_pointcloud",
            "SLAM",
            "error of the path",
            "{slam.path_error_m x1000|.0f}",
        ),
    ),
)
TABLES: Mapping[str, Table] = {
    "first_screen": FIRST_SCREEN,
    "figures": FIGURES,
    "safety": SAFETY,
    "lidar_peers": LIDAR_PEERS,
    "env_throughput": THROUGHPUT,
    "real_lidars": REAL_LIDARS,
    "env_scaling": SCALING,
    "table1": TABLE1,
    "table2": TABLE2,
    "table2_hokuyo": TABLE2_HOKUYO,
    "table3": TABLE3,
    "lidar_complexity": LIDAR_COMPLEXITY,
    "maps": MAPS,
    "fig4": FIG4,
    "estimator": ESTIMATOR,
    "transfer": TRANSFER,
    "robustness": ROBUSTNESS,
    "barn": BARN,
    "baselines": BASELINES,
    "training": TRAINING,
    "mujoco": MUJOCO,
    "real_drives": REAL_DRIVES,
}


@cache
def paths_of(run: str) -> tuple[tuple[str, ...], ...]:
    """The paths to all figures of a run that some table shows."""
    return tuple(
        tuple(match["path"].split("."))
        for table in TABLES.values()
        for row in table.rows
        for cell in row[1:]
        for match in PLACEHOLDER.finditer(cell)
        if (match["run"] or row[0]) == run
    )


# The tables, filled in.

REGION = re.compile(r"<!-- results:([a-z0-9_]+) -->\n(.*?)<!-- /results -->", re.DOTALL)
HOW = {"max": max, "min": min, "sum": sum, "mean": mean, "harmonic_mean": harmonic_mean}
NOT_MEASURED = "not measured"
OF_MISSED = "†"
ELSEWHERE = "§"
VERSIONS = ("numba", "numpy")
MOST_TOLD = 3  # bars that a run missed; of more, one fewer and how many more there are
MACHINE = "machine"
"""The name of the region that says on what was measured."""


class UnknownFigureError(Exception):
    """A path leads nowhere in what was measured."""


def found_at(value: Any, keys: Sequence[str]) -> Iterator[Any]:
    """What a path leads to; nothing when it leads nowhere."""
    if not keys:
        yield value
        return
    key = keys[0]
    rest = keys[1:]
    if key == "*":
        values = value.values() if isinstance(value, Mapping) else value
        for each in values if isinstance(value, Mapping | list) else ():
            yield from found_at(each, rest)
    elif isinstance(value, Mapping) and key in value:
        yield from found_at(value[key], rest)
    elif isinstance(value, list) and key.isdigit() and int(key) < len(value):
        yield from found_at(value[int(key)], rest)


def written(value: Any, how: str) -> str:
    """A value by a Python format, its exponent and per cent sign as in our texts."""
    text = format(value, how)
    if isinstance(value, str | bool):
        return text
    text = re.sub(
        r"e([+-])0*(\d+)$", lambda m: "e" + m[1].replace("+", "") + m[2], text
    )
    return re.sub(r"%$", " %", text)


def line_of(cells: Sequence[str]) -> str:
    """A line of a table."""
    return "|".join(["", *(f" {cell} " if cell else " " for cell in cells), ""])


def machine_of(entry: Mapping[str, Any]) -> str:
    """On what a run was made, in words."""
    machine = entry["machine"]
    return f"{machine['cores']} shared cores ({machine['cpu']})"


class Page:
    """The tables of one set of results."""

    def __init__(self, results: Mapping[str, Any]) -> None:
        self.runs = results
        machines = Counter(map(machine_of, self.runs.values()))
        self.machines = [machine for machine, _ in machines.most_common()]
        """In words, that of most runs first."""

    def figure(self, match: re.Match[str], run: str) -> str:
        """One placeholder. Raises UnknownFigureError."""
        result = self.runs.get(match["run"] or run, {}).get("result")
        values = list(found_at(result, match["path"].split(".")))
        if not values or any(
            value is None or isinstance(value, dict | list) for value in values
        ):
            raise UnknownFigureError
        value = HOW[match["how"]](values) if match["how"] else values[0]
        if match["factor"]:
            value = float(value) * float(match["factor"])
        return written(value, match["format"] or "")

    def cell(self, template: str, run: str) -> tuple[str, set[str]]:
        """The text of a cell, and the runs that it is from."""
        runs = {match["run"] or run for match in PLACEHOLDER.finditer(template)}
        try:
            text = PLACEHOLDER.sub(lambda match: self.figure(match, run), template)
        except (UnknownFigureError, ValueError, TypeError):
            return NOT_MEASURED, runs
        return "".join([text, *(f" {mark}" for mark in self.marks(runs))]), runs

    def elsewhere(self, run: str) -> bool:
        """Whether a run was made on another machine than most."""
        return machine_of(self.runs[run]) != self.machines[0]

    def marks(self, runs: set[str]) -> list[str]:
        """Signs for a cell whose runs missed a bar, or were made on another machine."""
        known = [name for name in runs if name in self.runs]
        signs = {
            OF_MISSED: any(self.runs[name]["state"] != MET for name in known),
            ELSEWHERE: any(map(self.elsewhere, known)),
        }
        return [sign for sign, holds in signs.items() if holds]

    def table(self, table: Table) -> str:
        """A table, and below it what is not as it should be with its runs."""
        lines = [line_of(table.head), f"|{'---|' * len(table.head)}"]
        used: set[str] = set()
        for run, *cells in table.rows:
            told = [self.cell(each, run) for each in cells]
            lines.append(line_of([text for text, _ in told]))
            used |= {name for _, runs in told for name in runs}
        if table.notes:
            lines += self.notes(used)
        return "\n".join(lines) + "\n"

    def notes(self, runs: set[str]) -> list[str]:
        """A sentence for each run that missed a bar or broke."""
        notes = []
        for name in sorted(runs & set(self.runs)):
            entry = self.runs[name]
            if entry["state"] != MET:
                told = entry["failures"] or [entry["error"] or ""]
                shown = told if len(told) <= MOST_TOLD else told[: MOST_TOLD - 1]
                wrong = "; ".join(shown)
                wrong = shorten(wrong, 300, placeholder=" ...")  # between words
                if more := len(told) - len(shown):
                    wrong += f"; and {more} more"
                notes.append(
                    f"{OF_MISSED} `{entry['script']}` {entry['state']}: {wrong}"
                )
        away = sorted({name for name in runs & set(self.runs) if self.elsewhere(name)})
        if away:
            notes.append(f"{ELSEWHERE} on {', '.join(self.machines[1:])}")
        return [line for note in notes for line in ("", note)]

    def about(self) -> str:
        """On what was measured."""
        if not self.runs:
            return "Nothing is measured yet.\n"
        entries = [self.runs[name] for name in self.runs]
        machine = next(
            e["machine"] for e in entries if machine_of(e) == self.machines[0]
        )
        others = "".join(
            f", or on {one} where marked {ELSEWHERE}" for one in self.machines[1:]
        )
        commits = {e["commit"] for e in entries}
        changed = " and changes" if any(e["dirty"] for e in entries) else ""
        told = (
            f"{len(commits)} commits"
            if len(commits) > 1
            else f"commit {entries[0]['commit']}"
        )
        days = sorted(e["started"][:10] for e in entries)
        loads = [e["load"] for e in entries]
        versions = [f"Python {machine['python']}"]
        libraries = machine.get("libraries", {})
        versions += [
            f"{name} {libraries[name]}" for name in VERSIONS if name in libraries
        ]
        return (
            f"On {self.machines[0]} with {machine['memory_gb']:.0f} GB{others}, "
            f"{', '.join(versions)}; load average before each run "
            f"{min(loads):.1f} to {max(loads):.1f}; {told}{changed}, {days[0]} to "
            f"{days[-1]}, each in `benchmarks/results.json`:\n"
        )

    def text(self, name: str) -> str:
        """What stands in a region. Raises KeyError for a name that there is not."""
        return self.about() if name == MACHINE else self.table(TABLES[name])


def rendered(text: str, page: Page) -> str:
    """A document with all its regions regenerated."""
    return REGION.sub(
        lambda match: (
            f"<!-- results:{match[1]} -->\n{page.text(match[1])}<!-- /results -->"
        ),
        text,
    )


def documents() -> list[Path]:
    """The files that may have regions."""
    return [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]


def write_tables(check: bool = False) -> int:
    """Writes the tables of all documents, or only says which are stale; the exit code."""
    page = Page(read_results(RESULTS))
    stale = 0
    for path in documents():
        before = path.read_text(encoding="utf-8")
        after = rendered(before, page)
        if after == before:
            continue
        stale += 1
        if not check:
            path.write_text(after, encoding="utf-8")
        told = (
            "is not what results.json gives; run `make tables`" if check else "written"
        )
        sys.stdout.write(f"{path.relative_to(ROOT)}: {told}\n")
    return int(check and stale > 0)
