"""Terms of robots whose state follows the commands and was not measured."""

from collections.abc import Iterator, Sequence

import numpy as np

from nics_drl_bridge.identify.excitation import terms_through_state
from nics_drl_bridge.identify.motion import HORIZON_S, Mask, Powers, Trial, chosen, mirrored
from nics_drl_bridge.robot.spec import RobotSpec

ORDERS = (2, 3, 4)  # of which `auto` chooses


def through_state(powers: Powers, spec: RobotSpec, centred: bool) -> Mask:
    """Selects the terms (D, K) that each degree of freedom may have.

    Where poses are those of the robot's `centred` reference point, motion along x is even in what a
    mirror reverses, and beyond the first order the rest is odd. States lag behind their commands.
    """
    names, odd, order = spec.variable_names, mirrored(spec), powers.sum(axis=1)
    unmoved = [name for name, most in zip(names, powers.max(axis=0), strict=True) if most == 0]
    allowed = np.ones((len(spec.dof_names), len(powers)), dtype=np.bool_)
    allowed[:3] = terms_through_state(powers, spec, tuple(unmoved))
    if odd is not None and centred:
        aside = powers[:, [name in odd for name in names]].sum(axis=1) % 2 == 1
        allowed[0] &= ~aside
        allowed[1:3] &= aside | (order <= 1)
    for i, variable in enumerate(spec.state):
        own = [names.index(variable.name), names.index(str(variable.follows))]
        allowed[3 + i] = (order == 1) & powers[:, own].any(axis=1)
    return allowed


def about_orders(trials: Sequence[Trial]) -> Iterator[str]:
    """Tells of a higher order than the usual one."""
    if trials and (best := chosen(list(trials))) is not trials[0]:
        errors = ", ".join(f"{trial.error:.1%} by order {trial.order}" for trial in trials)
        finding = f"The model has terms up to order {best.order}"
        unseen = f"predictions over {HORIZON_S:g} s of parts that a fit did not see"
        yield f"{finding}: {unseen} end {errors} of the path away."
