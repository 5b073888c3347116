"""A protocol, and rows of the logs of a run."""

from __future__ import annotations

from dataclasses import replace

from nics_drl_bridge.gate.assurance.protocol import Protocol

PROTOCOL = Protocol(
    policy="differential",
    limits="differential",
    model="differential",
    worlds=("arena", "crowd"),
    episodes=1500,
    faults=0,
    seed=7,
    randomisation="mild",
    control="",
    hashes={"policy file": "1"},
    versions={"numpy": "2"},
)
FAULTS = replace(
    PROTOCOL, faults=7, fault_kinds=("a", "b", "c"), fault_controls=("a", "b")
)


def row(seed, **changes):
    return {
        "kind": "ram",
        "world": "arena",
        "seed": seed,
        "gated": True,
        "contact": False,
        "walked_into": False,
        "latched": "",
        "path": 1.0,
        "seconds": 5.0,
        "position": [0.2, -3.1],
        "violations": {},
        **changes,
    }


def fault(seed, **changes):
    return {
        "kind": "nan_scan",
        "world": "",
        "seed": seed,
        "gated": True,
        "fault": True,
        "in_time": True,
        **changes,
    }
