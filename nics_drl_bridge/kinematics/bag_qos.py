"""Quality of service, as a bag keeps what its publishers offered."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rosbags.interfaces import Qos


@dataclass(frozen=True)
class Offer:
    """What a publisher offers, as far as it decides who hears it.

    Attributes:
        depth: of its history.
        reliable: or best effort.
        transient_local: late subscribers get what was sent before; or volatile.
    """

    depth: int = 10
    reliable: bool = True
    transient_local: bool = False


def offers_of(profiles: Sequence[Qos]) -> tuple[Offer, ...]:
    """What was offered, of the profiles that rosbags gives."""
    from rosbags.interfaces import QosDurability, QosReliability

    return tuple(
        Offer(
            max(int(profile.depth), 1),
            profile.reliability is not QosReliability.BEST_EFFORT,
            profile.durability is QosDurability.TRANSIENT_LOCAL,
        )
        for profile in profiles
    )


def profile_of(offer: Offer) -> Qos:
    """The same as a profile of rosbags; what does not matter here is at its default."""
    from rosbags.interfaces import (
        Qos,
        QosDurability,
        QosHistory,
        QosLiveliness,
        QosReliability,
        QosTime,
    )

    forever = QosTime(9223372036, 854775807)
    return Qos(
        QosHistory.KEEP_LAST,
        offer.depth,
        QosReliability.RELIABLE if offer.reliable else QosReliability.BEST_EFFORT,
        QosDurability.TRANSIENT_LOCAL if offer.transient_local else QosDurability.VOLATILE,
        forever, forever, QosLiveliness.AUTOMATIC, forever, False,
    )  # fmt: skip
