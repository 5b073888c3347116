"""Whether a robot's scans are those of the lidar that is expected."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.report.doctor_expected import Expected, Finding, filling
from nics_drl_bridge.report.doctor_facts import SCAN, Facts, Layout

LAYOUT = "beam layout"
ANGLE_TOLERANCE = 0.5
"""Of a beam's direction, in increments."""
ODD_SHARE = 0.01
"""A lidar that puts a value on the wire in more than this share of its beams means it."""


def layout(facts: Facts, expected: Expected) -> Iterator[Finding]:
    """Number and directions of the beams, and limits of their ranges."""
    name = facts.names[SCAN]
    if len(facts.layouts) > 1:
        counts = sorted({one.beams for one in facts.layouts})
        what = f"its header changes; numbers of beams are {', '.join(map(str, counts))}"
        fix = "use the driver's mode of fixed angles (as `angle_compensate`), or resample"
        yield Finding("error", LAYOUT, name, what, fix)
    for have in facts.layouts[:1]:
        yield from _header(have, name)
        unfilled = _unfilled(have, expected)
        if unfilled:
            fix = "turn or set the lidar, or train a policy with what it sees"
            yield Finding("error", LAYOUT, name, unfilled, fix)
        else:
            yield from _beams(have, expected, name)


def _unfilled(have: Layout, expected: Expected) -> str:
    """Why a lidar does not fill the sectors that are wanted; empty if it does, or none are."""
    try:
        if expected.scan is not None:
            filling(have, expected.lidar, expected.scan)
    except ConfigError as error:
        return str(error)
    return ""


def _header(have: Layout, name: str) -> Iterator[Finding]:
    """Whether a header agrees with itself."""
    if abs(have.last - have.angle_max) > ANGLE_TOLERANCE * max(abs(have.angle_increment), 1e-9):
        what = f"angle_max is {have.angle_max:.5f}, but its beams end at {have.last:.5f} rad"
        yield Finding("warning", LAYOUT, name, what, "correct the driver's header")
    if have.in_degrees:
        what = f"angles go from {have.angle_min:.4g} to {have.angle_max:.4g}: degrees"
        yield Finding("error", "unit", name, what, "let the driver send radians")


def _beams(have: Layout, expected: Expected, name: str) -> Iterator[Finding]:
    """Whether a header's beams are those of a lidar."""
    want = expected.lidar.header
    fix = "set the driver, or make a lidar file of what it sends and generate the model anew"
    if have.beams != expected.lidar.beams:
        what = f"has {have.beams} beams, expected {expected.lidar.beams}"
        yield Finding("error", LAYOUT, name, what, fix)
    if have.angle_increment < 0.0:
        if expected.scan is None and not have.in_degrees:
            what = "its beams go clockwise (angle_increment is negative)"
            turn = "turn the order in the driver (`inverted`): they go counter-clockwise (REP-103)"
            yield Finding("error", LAYOUT, name, what, turn)
    elif not have.in_degrees and max(
        abs(have.angle_min - want.angle_min), abs(have.last - want.angle_max)
    ) > ANGLE_TOLERANCE * abs(want.angle_increment):
        what = (
            f"beams go from {have.angle_min:.4f} to {have.last:.4f} rad, expected "
            f"{want.angle_min:.4f} to {want.angle_max:.4f}"
        )
        yield Finding("error", LAYOUT, name, what, fix)
    for key in ("range_min", "range_max"):
        ours, theirs = getattr(want, key), getattr(have, key)
        if abs(ours - theirs) > 0.01 * max(abs(ours), 1e-3) + 1e-6:
            big = theirs > 100.0 * max(ours, 0.1)
            what = f"{key} is {theirs:.4g}, expected {ours:.4g} m"
            kind = "unit" if big else "range limits"
            yield Finding("error" if big else "warning", kind, name, what, fix)


def ranges(facts: Facts, expected: Expected) -> Iterator[Finding]:
    """What the lidar puts on the wire where nothing came back, and its unit."""
    if not facts.ranges:
        return
    spec, name = expected.lidar, facts.names[SCAN]
    values = np.concatenate(facts.ranges).astype(np.float64)
    finite = values[np.isfinite(values) & (values > 0.0)]
    beyond = finite > 1.001 * spec.range_max
    if len(finite) and np.median(finite) > 20.0 * spec.range_max:
        what = f"half of the ranges exceed {np.median(finite):.0f}: millimetres"
        yield Finding("error", "unit", name, what, "let the driver send metres")
        return
    if len(finite) and beyond.mean() > ODD_SHARE:
        what = f"{100 * beyond.mean():.0f} % of the ranges exceed range_max {spec.range_max:g} m"
        fix = "set the driver's limit, or range_max of the lidar, and generate the model anew"
        yield Finding("warning", "range convention", name, what, fix)
    at_max = np.abs(values - spec.range_max) < 1e-4 * spec.range_max
    for word, hit in (
        ("zero", values == 0.0),
        ("nan", np.isnan(values)),
        ("range_max", at_max),
        ("inf", values == np.inf),
    ):
        if hit.mean() > ODD_SHARE and word != spec.no_return:
            what = (
                f"{100 * hit.mean():.0f} % of the ranges are {word}, but no return is expected "
                f"as {spec.no_return}"
            )
            fix = f"set `no_return: {word}` in the lidar and generate the model anew"
            yield Finding("error", "range convention", name, what, fix)
    if (values < 0.0).any() and np.isfinite(values[values < 0.0]).any():
        fix = "correct the driver: too close is -inf (REP-117), nothing else is negative"
        yield Finding("error", "range convention", name, "holds negative ranges", fix)
