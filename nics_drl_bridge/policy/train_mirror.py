"""Mirrored transitions: a robot that learnt to pass on the left has learnt to pass on the right.

About half of the transitions of a rollout, drawn at random, are replaced by their mirror images
(Abdolhosseini and others 2019, `DUP` without the copies). Their old probability is that with which
the policy that drove would have done the mirrored action.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray

from nics_drl_bridge.env.mirror import Mirror

if TYPE_CHECKING:
    from nics_drl_bridge.policy.train_ppo import Networks, Transitions

Array = NDArray[np.float64]


class Reflection:
    """Mirrors transitions; `extra` features follow an observation, scans of `parts`."""

    def __init__(self, mirror: Mirror, extra: int, parts: int) -> None:
        self._mirror, count = mirror, len(mirror.places)
        scans = [first + mirror.places[:parts] for first in range(count, count + extra, parts or 1)]
        places = np.concatenate([mirror.places, *scans])
        signs = np.concatenate([mirror.signs, np.ones(extra)])
        self._places, self._acted = torch.from_numpy(places), torch.from_numpy(mirror.acted)
        self._signs, self._scale, self._offset = (
            torch.from_numpy(each.astype(np.float32))
            for each in (signs, mirror.scale, mirror.offset)
        )
        self._uneven = torch.from_numpy((mirror.offset != 0.0) | (np.abs(mirror.scale) != 1.0))

    def balanced(self, mean: Array, std: Array) -> tuple[Array, Array]:
        """Mean and deviation (O,) of observations that are mirrored half of the time.

        A normaliser with them mirrors alike before and after.
        """
        places, signs = self._mirror.places, self._mirror.signs
        other = signs * mean[places]
        spread = 0.5 * (std**2 + std[places] ** 2) + 0.25 * (mean - other) ** 2
        return 0.5 * (mean + other), np.sqrt(spread)

    def seen(self, features: torch.Tensor) -> torch.Tensor:
        """Mirrors features (n, F)."""
        return features[:, self._places] * self._signs

    def actions(self, actions: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Mirrors actions (n, C), or (n,) discrete; and tells which (n,) the robot can do."""
        if not len(self._scale):
            return self._acted[actions], torch.ones(len(actions), dtype=torch.bool)
        mirrored = actions[:, self._acted] * self._scale + self._offset
        beyond = (mirrored.abs() > 1.0) & self._uneven
        return mirrored, ~beyond.any(1)

    def mirror(
        self, rollout: Transitions, networks: Networks, generator: torch.Generator
    ) -> Transitions:
        """Replaces half of the transitions, of those whose mirror image the robot can do."""
        actions, possible = self.actions(rollout.actions)
        drawn = torch.rand(len(possible), generator=generator) < 0.5
        rows = (drawn & possible).nonzero().squeeze(1)
        seen = self.seen(rollout.seen[rows])
        log_probs = networks.log_probs(networks.actor.layers(seen), actions[rows])
        return rollout._replace(
            seen=rollout.seen.index_copy(0, rows, seen),
            actions=rollout.actions.index_copy(0, rows, actions[rows]),
            log_probs=rollout.log_probs.index_copy(0, rows, log_probs),
        )
