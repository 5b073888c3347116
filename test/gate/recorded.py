"""What the gate decides in drives full of faults, and what it computes on the way, as recorded.

Times and limits are multiples of 1/64, so that data are exactly as old as they may be.

    cd test && ../.venv/bin/python -m gate.recorded     # records anew
"""

from __future__ import annotations

import json
import zlib
from dataclasses import is_dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from digests.projection import projected

from gate.rig import config
from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.gate import evidence, frozen, shield_kernels, stopping
from nics_drl_bridge.gate.assurance.episodes import configure_gate
from nics_drl_bridge.gate.assurance.episodes import drive as drive_episode
from nics_drl_bridge.gate.assurance.limit_judge import LimitJudge
from nics_drl_bridge.gate.assurance.place import POLICY, Job, Place
from nics_drl_bridge.gate.assurance.protocol import KINDS
from nics_drl_bridge.gate.gate import decide
from nics_drl_bridge.gate.inputs import (
    Arm,
    Command,
    Estimate,
    EStop,
    Odometry,
    Press,
    Reset,
    Scan,
    SensorReading,
    Tick,
)
from nics_drl_bridge.gate.limits import follow, load_limits, saturate
from nics_drl_bridge.gate.shield import list_stops
from nics_drl_bridge.gate.state import ShieldConfig, View, begin
from nics_drl_bridge.generator import builtin_model
from nics_drl_bridge.geometry import Bicycle, compose, exp
from nics_drl_bridge.robot.braking import Drift, TurnBraking

FILE = Path(__file__).with_name("recorded.json")
UNIT_NS = 15_625_000
UNIT_S = 1.0 / 64.0
BOX = ((0.25, 0.2), (-0.25, 0.2), (-0.25, -0.2), (0.25, -0.2))
ROUND = ShieldConfig(0.125, 1.0, 0.0625, 0.25, 0.25, obstacle_speed=0.5, range_max=12.0)
CORNERED = replace(ROUND, outline=BOX, footprint_radius=float(np.hypot(0.25, 0.2)))
SHIELDS = {
    "round": ROUND,
    "car": replace(ROUND, wheelbase=0.2, obstacle_speed=0.0),
    "drifting": replace(CORNERED, drift=Drift(0.9, 2.0, 1.1), lever=0.2, order=1.0),
    "steady": replace(CORNERED, turn=TurnBraking(0.4, 3.0)),
    "turning": replace(CORNERED, turn=TurnBraking(0.4, 3.0, 0.6, 0.5), order=np.inf),
}
WALLS = np.array(
    [
        [-3.0, -2.0, 3.0, -2.0],
        [3.0, -2.0, 3.0, 2.5],
        [3.0, 2.5, -3.0, 2.5],
        [-3.0, 2.5, -3.0, -2.0],
        [0.5, 1.2, 1.4, 1.2],
        [-1.5, -0.8, -1.5, -1.4],
    ]
)
FAULTS = (
    *("scan", "odom", "estimate", "e_stop", "command", "rear", "asleep", "pressed"),
    *("called", "held", "stuck", "frozen", "blind", "late", "ahead", "back", "lost"),
    *("uncertain", "leap", "wild", "unknown", "broken", "two", "many", "stopped"),
)
# Faults that show only after a path, with the time they take [units]; others show in half a second.
SLOW = {"held": 70, "stuck": 70, "frozen": 128}
# Robot, shield, number of beams, and changes of the configuration. Every robot has some of the
# faults; a frozen scan shows on the car, because its gate looks for no held body.
DRIVES = {
    "circle": ("differential", ROUND, 360, {}),
    "car": (
        "ackermann",
        SHIELDS["car"],
        180,
        {"bicycle": Bicycle(0.2), "stop_when_held": False},
    ),
    "half blind": ("differential", SHIELDS["turning"], 270, {"sensors": ("rear",)}),
    "drifting": ("mecanum", SHIELDS["drifting"], 360, {"odom_rate_declared": False}),
    "simulated": (
        "mecanum",
        None,
        90,
        {"simulated": True, "e_stop_required": False, "estimate_required": False},
    ),
}

SOME_FAULTS = {
    "circle": FAULTS[1::2],
    "car": (*FAULTS[::2], "frozen"),
    "half blind": [fault for fault in FAULTS if fault != "frozen"],
    "drifting": FAULTS[2::3],
    "simulated": FAULTS[::3],
}


def see(pose, angles, walls=WALLS):
    """Ranges (B,) to the nearest of walls (W, 4) from a pose (3,)."""
    bearings = angles + pose[2]
    ux = np.cos(bearings)[:, None]
    uy = np.sin(bearings)[:, None]
    start = walls[:, :2] - pose[:2]
    edge = walls[:, 2:] - walls[:, :2]
    with np.errstate(divide="ignore", invalid="ignore"):
        across = ux * edge[:, 1] - uy * edge[:, 0]
        along = (start[:, 0] * edge[:, 1] - start[:, 1] * edge[:, 0]) / across
        share = (start[:, 0] * uy - start[:, 1] * ux) / across
    hit = (along > 0.0) & (share >= 0.0) & (share <= 1.0)
    return np.where(hit, along, np.inf).min(axis=1, initial=np.inf)


def flatten(value):
    """All numbers of a record, in order; words count by their checksum."""
    if is_dataclass(value):
        value = tuple(vars(value).values())
    if isinstance(value, tuple | list):
        return [number for part in value for number in flatten(part)]
    if isinstance(value, str):
        return [zlib.crc32(value.encode()) % 1000]
    if value is None:
        return [-7.0]
    array = np.nan_to_num(
        np.ravel(value).astype(float), nan=-3.0, posinf=5.0, neginf=-5.0
    )
    return np.where(np.abs(array) > 1e6, array % 1e6, array).tolist()


class FaultyDrive:
    """A robot in a room, which has one fault after the other, and its gate."""

    def __init__(self, robot, shield, beams, changes):
        step = np.pi / 180.0
        self.angles = (np.arange(beams) - beams / 2) * step
        self.config = config(
            robot,
            **{
                "shield": shield,
                "beam_angles": self.angles,
                "mount": (0.1, 0.0, 0.0),
                "scan_rate": 8.0,
                "odom_rate": 8.0,
                "scan_age_s": 0.25,
                "odom_age_s": 0.25,
                "command_age_s": 0.25,
                "race_s": 0.0625,
                "settle_s": 0.5,
                "gap_s": 0.25,
                "frozen_distance": 0.25,
                "stop_when_held": True,
                "odom_std": (0.01, 0.02),
                "range_noise": (0.01, 0.0),
                **changes,
            },
        )
        self.rng = np.random.default_rng(len(self.config.fields) + beams)
        self.state = begin(self.config)
        self.units = 0
        self.lead = 0  # of the stamps [units]
        self.body = np.zeros(3)
        self.odometry = np.zeros(3)
        self.twist = np.zeros(3)
        self.picture = None
        self.fault = ""
        self.words = ()
        self.answer = ""  # the last one to a request
        self.lines = []
        self.decisions = []
        self.sums = [projected(flatten(self.state))]

    def give(self, event):
        now = 128.0 + self.units * UNIT_S
        self.state, decision = decide(self.config, self.state, event, now)
        rule = "" if decision.cause is None else decision.cause.line
        self.answer = decision.answer or self.answer
        words = (rule.partition(":")[0], self.answer, decision.refused)
        if words != self.words:
            self.words = words
            self.lines.append(f"{self.units} {rule} {self.answer} {decision.refused}")
        self.decisions.append(decision)
        return decision

    def send(self):
        """What arrives in a period, as far as the fault lets it."""
        fault = self.fault
        stamp = (self.units + self.lead) * UNIT_NS + 10**18
        noise = self.rng.normal(0.0, 0.005, len(self.angles))
        ranges = see(compose(self.body, [0.1, 0.0, 0.0]), self.angles) + noise
        if fault == "frozen":
            ranges = self.picture
        self.picture = ranges
        ranges = ranges.astype(np.float32)
        if fault == "blind":
            ranges[::2] = np.nan
            ranges[1::5] = -np.inf
        angles = (float(self.angles[0]), float(self.angles[1] - self.angles[0]))
        turn = 50.0 if fault == "leap" else 0.0
        if fault != "odom":
            self.give(Odometry(stamp, self.odometry + turn, self.twist.copy()))
        if fault != "rear" and self.config.sensors:
            rear = np.array([[-1.0, 0.1 * self.rng.random()]])
            self.give(SensorReading(stamp, "rear", rear))
        if fault != "scan":
            self.give(
                Scan(stamp - (4 * UNIT_NS if fault == "late" else 0), ranges, angles)
            )
        if fault != "estimate":
            std = 0.8 if fault == "uncertain" else 0.01
            away = 2.0 if fault == "lost" else 0.0
            pose = self.odometry + np.array([away, 0.0, 0.0])
            self.give(Estimate(self.twist.copy(), pose, std**2 * np.eye(3)))
        if fault != "e_stop":
            self.give(EStop(fault == "pressed"))
        if fault != "command":
            wish = self.rng.uniform(-0.3, 0.8, 3) * (fault != "stopped")
            wish = wish * (1e6 if fault == "wild" else 1.0)
            named = stamp + 1 if fault == "unknown" else stamp
            source = "/other" if fault == "two" else "/policy"
            wish[self.rng.integers(3)] *= np.nan if fault == "broken" else 1.0
            self.give(Command(named, wish, source, 1 + (fault == "many")))
        if fault == "called":
            self.give(Press())

    def run(self, units):
        for _ in range(units):
            self.units += 1
            wheels = exp(UNIT_S * self.twist)
            if self.fault != "held":
                self.body = compose(self.body, wheels)
            self.odometry = compose(self.odometry, wheels)
            self.lead += {"ahead": 1, "back": -1}.get(self.fault, 0)
            if self.units % 8 == 0:
                self.send()
            decision = self.give(Tick())
            self.twist = decision.twist * (self.fault != "stuck")
            if self.units % 32 == 0:
                self.sums.append(projected(flatten(self.state)))

    def break_down(self, fault):
        """Stands, is armed, drives, and has a fault; returns whether it is stopped at the end."""
        self.fault = ""
        self.rng = np.random.default_rng(FAULTS.index(fault))
        self.body = self.rng.uniform(-1.0, 1.0, 3)
        self.give(Reset())
        for _ in range(40):
            self.run(1)
            if not self.state.armed:
                self.give(Arm(1))
        self.run(30)
        self.fault = fault
        if fault == "asleep":
            self.units += 20
        self.run(SLOW.get(fault, 32))
        return not self.decisions[-1].twist.any()

    def recover(self):
        """Has no fault any more, and is told to stand."""
        self.fault = "stopped"
        self.run(8)


def record_drive(name, check=lambda drive, fault, stopped: None):
    """Yields what was decided around each fault, and the numbers of all states."""
    drive = FaultyDrive(*DRIVES[name])
    drive.run(16)
    drive.give(Arm(2))
    for fault in SOME_FAULTS.get(name, FAULTS):
        stopped = drive.break_down(fault)
        drive.recover()
        check(drive, fault, stopped)
        told = [(*each.twist, each.publish, each.shielded) for each in drive.decisions]
        yield drive.lines, [projected(told), *drive.sums]
        drive.lines = []
        drive.decisions = []
        drive.sums = []


def record_stops():
    """Yields which points the shield takes for free, for stops and bodies of all kinds."""
    rng = np.random.default_rng(0)
    for shield in SHIELDS.values():
        stops = [
            stop
            for braking, latencies in ((0.5, 2.0), (1.0, 1.0))
            for stop in list_stops(shield, 0.5, braking, latencies)
        ]
        free = []
        for stop in stops:
            twists = rng.uniform(-1.0, 1.0, (40, 3)) * rng.integers(0, 2, (40, 3))
            points = rng.uniform(-1.0, 1.0, (40, 1, 3)) * (1.0, 1.0, 0.5)
            points[::2, :, 2] = 0.0
            free += [
                shield_kernels.is_free(point, twist[None], stop, 0.02)
                for point in points
                for twist in twists
            ]
        yield [], [flatten(stops)[:200], projected(free)]


def record_evidence():
    """Yields movers, motions and obstacles of scans from two places, one of which may be wrong."""
    rng = np.random.default_rng(1)
    for beams in (360, 270):
        drive = FaultyDrive("mecanum", SHIELDS["round"], beams, {})
        given = drive.config
        for _ in range(12):
            twist = rng.uniform(-1.0, 1.0, 3) * rng.integers(0, 2, 3)
            shown = rng.choice([0.0, 0.5, 1.0, 1.3])
            walker = np.array([[0.9, -0.3, 0.9, 0.3]]) * rng.choice([0.0, 1.0])
            views = []
            for k in range(3):
                pose = exp(0.1 * k * shown * twist)
                walls = np.concatenate([WALLS, walker - 0.1 * k])
                ranges = see(pose, drive.angles, walls).astype(np.float32)
                ranges[rng.random(beams) < 0.02] = rng.choice([np.nan, np.inf, -np.inf])
                views.append(View(k * 10**8, exp(0.1 * k * twist), ranges))
            found = evidence.find_obstacles(given, views[-1].ranges, tuple(views))
            moved = exp(0.2 * twist)
            changed = frozen.must_differ(given, views[0].ranges, moved)
            yield [], [projected(found), projected(changed)]


def record_limits():
    """Yields how commands of all robots follow wishes."""
    rng = np.random.default_rng(2)
    for robot in ("ackermann", "jackal"):
        model = builtin_model(robot)
        bounds = load_limits(robot, model.robot)
        value = slope = np.zeros(len(bounds.low))
        rows = []
        for _ in range(300):
            wish = saturate(rng.normal(size=len(value)) * rng.choice([0, 1, 9]), bounds)
            value, slope = follow(
                value, slope, wish, rng.uniform(0, 0.1), bounds, rng.random() < 0.5
            )
            rows.append(np.concatenate([wish, value, slope]))
        shield, said = stopping.shield_config(model, bounds, overrides={"margin": 0.1})
        given = stopping.make_gate_config(model, bounds, shield)
        assumed, _ = stopping.shield_config(model, None)
        yield [said], [projected(rows), *map(flatten, (shield, assumed, given))]


def record_settings():
    """Yields which settings let a gate be armed, and which are warned of."""
    lines = []
    for rate in (1.0, 1.5, 2.0, 4.0, 16.0):
        for age in (0.0625, 0.25, 0.5, 1.0):
            given = config(
                scan_rate=rate, odom_rate=4.0, scan_age_s=age, odom_age_s=0.5
            )
            try:
                stopping.require_possible(given)
            except ConfigError as error:
                lines.append(str(error))
            slow = replace(given, command_age_s=age)
            lines.append(stopping.warn_of_age_limit(slow, 1.0 / rate))
    yield lines, []


def record_episodes():
    """Yields how episodes of all drivers end, behind a gate and without one."""
    model = builtin_model("differential")
    bounds = load_limits("differential", model.robot)
    place = Place(model, "crowd", "straight")
    for seed, kind in enumerate(KINDS):
        for settings in (None, configure_gate(place.model, "differential")):
            if settings is not None and kind == POLICY:
                continue  # its episode is long
            judge = LimitJudge(model.robot, bounds)
            outcome = drive_episode(place, settings, Job(kind, seed), judge.see)
            counts = list(judge.violations.values())
            yield [outcome.latched], [flatten(outcome), counts]


RECORDS = {
    **{name: partial(record_drive, name) for name in DRIVES},
    "stops": record_stops,
    "evidence": record_evidence,
    "limits": record_limits,
    "settings": record_settings,
    "episodes": record_episodes,
}


if __name__ == "__main__":
    FILE.write_text(
        json.dumps({name: list(record()) for name, record in RECORDS.items()})
    )
