"""Structure in the residuals of a model: what rates still depend on beyond its terms."""

from collections.abc import Collection, Iterator

import numpy as np

from nics_drl_bridge.geometry import Array
from nics_drl_bridge.recording.recording import Samples
from nics_drl_bridge.robot import taylor
from nics_drl_bridge.robot.spec import RobotSpec
from nics_drl_bridge.robot.taylor import TaylorModel

DEGREE = 3  # of the terms that are looked for
BLOCK_S = 2.5  # residuals this far apart are independent
FEWEST = 12  # blocks to tell by
SIGNIFICANT = 3.5  # standard errors, between the blocks, of the correlation with a term
SHARE = 0.1  # of the residual's variance that a term explains in blocks that it was not fitted to
WORTH = 0.01  # least size of that, as a share of the rate's
OUTLYING = 9.0  # residuals are cut at this many times their median
PARTS = 5  # in which blocks are left out
ROWS = 3000  # that are looked at, as neighbours tell the same


def structures(
    model: TaylorModel,
    samples: Samples,
    spec: RobotSpec,
    unmoved: Collection[str] = (),
    tried: int = 0,
) -> Iterator[str]:
    """Tells, per degree of freedom, the term that explains most of the residuals, if one does.

    `unmoved` variables hold nothing but noise; `tried` is the greatest order that was tried.
    """
    samples = samples.rows(
        np.arange(len(samples.t)) % (1 + len(samples.t) // ROWS) == 0
    )
    block = np.floor((samples.t - samples.t[0]) / BLOCK_S).astype(np.intp)
    x = samples.x
    moved = np.ptp(samples.x, axis=0) > 0.0
    moved &= [name not in unmoved for name in model.variables]
    if not moved.any() or len(np.unique(block)) < FEWEST:
        return
    powers = taylor.exponents(x.shape[1], DEGREE)
    powers = powers[(powers[:, ~moved] == 0).all(axis=1) & powers.any(axis=1)]
    features = taylor.evaluate(x / np.maximum(np.abs(x).max(axis=0), 1e-12), powers)
    left = samples.dq - model.rates(x)
    known = {v.twist for v in spec.state} | {f"d_{name}" for name in unmoved}
    for d, dof in enumerate(model.dofs):
        used = model.coefficients[d] != 0.0
        if not used.any() or dof in known:
            continue
        own = taylor.evaluate(x, model.powers[used])
        own = own / np.maximum(np.sqrt((own**2).mean(axis=0)), 1e-12)
        both = np.concatenate([left[:, d : d + 1], features], axis=1)
        both = both - own @ np.linalg.lstsq(own, both, rcond=None)[0]
        most = OUTLYING * float(np.median(np.abs(both[:, 0])))
        rest = np.clip(both[:, 0], -most, most)
        more = both[:, 1:]
        told = (more**2).mean(axis=0) > 1e-6 * (features**2).mean(
            axis=0
        )  # not one of its own
        share = np.where(told, _share(rest, more, block), -np.inf)
        best = int(np.argmax(share))
        size = (
            share[best]
            * (rest**2).mean()
            / max(float((samples.dq[:, d] ** 2).mean()), 1e-18)
        )
        if share[best] > SHARE and size > WORTH**2:
            name = taylor.term_name(powers[best], model.variables)
            finding = f"What the model leaves of {dof} depends on {name}"
            way = _way(model, int(powers[best].sum()), tried)
            yield f"{finding} ({share[best]:.0%} of it, by cross-validation): {way}."


def _way(model: TaylorModel, degree: int, tried: int) -> str:
    """Says what to do about a term of a degree that a model lacks."""
    order = int(
        model.powers[(model.coefficients != 0.0).any(axis=0)].sum(axis=1).max(initial=1)
    )
    if degree > max(order, tried):
        way = f"try order {degree}"
    elif model.bounded or tried > order:
        way = "no order that was tried predicts better with it"
    else:
        way = "keep more terms (a higher alpha)"
    if model.bounded:
        by_terms = ""
    else:
        by_terms = ", and distrust what rests on its terms, as the mounting"
    return way + by_terms


def _share(rest: Array, features: Array, block: Array) -> Array:
    """Returns the share (K,) of a residual's (T,) variance that features (T, K) tell, each alone.

    By cross-validation between blocks; below 0 for those that noise explains as well.
    """
    count = int(block[-1]) + 1
    per_block = np.eye(count)[:, block]  # (N, T)
    across = per_block @ (features * rest[:, None])
    size = per_block @ features**2
    total = float((rest**2).sum())
    slope = across.sum(axis=0) / np.maximum(size.sum(axis=0), 1e-18)
    spread = np.sqrt(((across - slope * size) ** 2).sum(axis=0))
    certain = np.abs(across.sum(axis=0)) > SIGNIFICANT * np.maximum(spread, 1e-18)
    left = np.zeros(features.shape[1])
    for part in range(PARTS):
        out = np.arange(count) * PARTS // count == part
        slope = across[~out].sum(axis=0) / np.maximum(size[~out].sum(axis=0), 1e-18)
        left += slope**2 * size[out].sum(axis=0) - 2.0 * slope * across[out].sum(axis=0)
    return np.asarray(np.where(certain, -left / max(total, 1e-18), -np.inf))
