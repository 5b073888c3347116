"""What a campaign of abuse counts."""

from __future__ import annotations

from dataclasses import dataclass, field

BARS = ("moved", "tracebacks", "hangs", "over_memory", "accepted")


@dataclass
class Score:
    """Of one campaign.

    Attributes:
        tries: how much was tried.
        moved: robots that moved after an error that had to stop them.
        tracebacks: errors that were no sentence of ours.
        hangs: answers that took longer than allowed.
        over_memory: answers that took more memory than allowed.
        accepted: bad input that was taken for good.
        told: a line for each of those, with what reproduces it.
    """

    tries: int = 0
    moved: int = 0
    tracebacks: int = 0
    hangs: int = 0
    over_memory: int = 0
    accepted: int = 0
    told: list[str] = field(default_factory=list)

    def count(self, bar: str, line: str) -> None:
        """Notes what must not have happened, by the name of the bar that it misses."""
        setattr(self, bar, getattr(self, bar) + 1)
        self.told.append(f"{bar}: {line}")
