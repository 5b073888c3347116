"""Mirrored transitions: a robot that learnt to pass on the left has learnt to pass on the right.

To the transitions of a rollout come their mirror images, with the same advantages and returns
(`DUP` of Abdolhosseini and others 2019). Each was as probable as the action that was drawn, since a
mirrored policy would have driven so. What the policy itself would have done in the mirrored place
is no measure: where it is not symmetric yet, ratios to that grow without bound.
"""

import numpy as np
import torch

from nics_drl_bridge.env.task import Mirror
from nics_drl_bridge.geometry import Array
from nics_drl_bridge.policy.train_rollout import Transitions


class Reflection:
    """Mirrors transitions; `extra` features follow an observation, scans of `parts`."""

    def __init__(self, mirror: Mirror, extra: int, parts: int) -> None:
        self._mirror = mirror
        count = len(mirror.places)
        scans = [
            first + mirror.places[:parts]
            for first in range(count, count + extra, parts or 1)
        ]
        places = np.concatenate([mirror.places, *scans])
        signs = np.concatenate([mirror.signs, np.ones(extra)])
        self._places = torch.from_numpy(places)
        self._acted = torch.from_numpy(mirror.acted)
        self._signs, self._scale, self._offset = (
            torch.from_numpy(each.astype(np.float32))
            for each in (signs, mirror.scale, mirror.offset)
        )
        self._uneven = torch.from_numpy(
            (mirror.offset != 0.0) | (np.abs(mirror.scale) != 1.0)
        )

    def balanced(self, mean: Array, std: Array) -> tuple[Array, Array]:
        """Mean and deviation (O,) of observations and their mirror images together.

        A normaliser with them mirrors alike before and after.
        """
        places = self._mirror.places
        signs = self._mirror.signs
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
        return mirrored, ~((mirrored.abs() > 1.0) & self._uneven).any(1)

    def doubled(self, rollout: Transitions) -> Transitions:
        """Adds the mirror images of the transitions, of those that the robot can do."""
        actions, possible = self.actions(rollout.actions)
        more = rollout._replace(
            seen=self.seen(rollout.seen),
            actions=actions,
            log_probs=rollout.log_probs - self._scale.abs().log().sum(),
        )
        pairs = zip(rollout[:5], more[:5], strict=True)
        return type(rollout)(
            *(torch.cat([one, other[possible]]) for one, other in pairs)
        )
