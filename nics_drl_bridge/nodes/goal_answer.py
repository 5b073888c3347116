"""A policy node's answer to a goal, as its diagnostics carry it; needs no ROS 2."""

from collections.abc import Mapping
from dataclasses import dataclass

STAMP = "stamp of the newest goal [ns]"
TAKEN = "newest goal taken"
TOLD = "newest goal"


@dataclass(frozen=True)
class GoalAnswer:
    """The answer to a goal: accepted or refused."""

    stamp_ns: int  # of the goal's message
    granted: bool
    told: str  # where the goal is, or why it was refused

    def to_facts(self) -> dict[str, object]:
        """Return the answer as facts of a node's diagnostics."""
        return {STAMP: self.stamp_ns, TAKEN: self.granted, TOLD: self.told}


def answer_from_values(values: Mapping[str, str]) -> GoalAnswer | None:
    """Return the answer among the values of a node's diagnostics, or None."""
    stamp = values.get(STAMP, "")
    if not stamp.isdecimal():
        return None
    return GoalAnswer(int(stamp), values.get(TAKEN) == str(True), values.get(TOLD, ""))
