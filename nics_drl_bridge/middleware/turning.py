"""Fuses the turns of odometry and of a gyro by their variances, as told and as seen.

Wheels slip where a robot turns: those of a skid-steer may report a third more than there was. A
gyro does not slip, but has noise and a bias that changes slowly. The bias is estimated while the
wheels stand and, with less weight, while they roll. What is fused replaces odometry's own turn, in
its twist and in the way between two of its poses; the wheels' displacements stay as they are.
"""

import math
from typing import NamedTuple

import numpy as np

from nics_drl_bridge import geometry
from nics_drl_bridge.geometry import Array
from nics_drl_bridge.interface import NS_PER_S

# The gyro.
GYRO_STD = 0.02  # of a yaw rate without a covariance that can be right [rad/s]
LEAST_STD = 1e-4  # lower bound on that [rad/s]
GREATEST_VARIANCE = 1.0  # a greater one says that the rate is not known [rad^2/s^2]
BIAS_STD = 0.1  # of a gyro that was never at rest [rad/s]
BIAS_WALK = 1e-4  # random walk of a bias [rad/s / sqrt(s)]
# by which the rate of standing wheels may differ from the bias [rad/s]
LEAST_BIAS_STD = 3e-4
CLAIM = 25.0  # factor by which a variance may differ from what is seen, and is believed
FEWEST_SEEN = 30  # yaw rates that show their noise
SMOOTHING = 0.05  # weight of a new yaw rate in that
# between two yaw rates; beyond, the wheels turn the robot [ns]
LONGEST_GAP_NS = 250_000_000
FROZEN = 25  # equal yaw rates in a row of a gyro that is stuck,
CHANGED_RADPS = 0.1  # if the wheels turn the robot so much faster or slower since
GREATEST_CHANGE = 40.0  # angular acceleration that no robot exceeds [rad/s^2]
ALWAYS_ALLOWED = 0.3  # change from one yaw rate to the next [rad/s]
FASTER = 2.0  # times its greatest turn rate that a robot may be turned
PUSHED_RADPS = 1.0  # and always so fast, by hand
PATIENCE = 5  # sudden changes in a row after which they are believed
MOST_REFUSED = 0.2  # share of the latest yaw rates
# The wheels.
SLIP = 0.1  # of their turns, as a share, until more is known
LEAST_SLIP = 0.05
SLIP_KNOWN = 1e-3  # square of turns [rad^2] that weighs as much as that assumption
MEMORY_S = 30.0
TURN_TO_TELL = 0.5  # rad by the wheels, before gyro and wheels are compared
SLOPES = (
    -0.3,
    3.0,
)  # of the gyro's turns to the wheels'; beyond, its axis or unit is wrong
LEAST_CONTRADICTION = 0.005  # rad, between two odometries
TURNING_RADPS = 0.1  # slower turns of the wheels do not show their slip
# of driving and standing, from which on the wheels' scatter is known
SCATTER_KNOWN_S = 5.0
WHEELS_BIAS = 0.004  # constant error of rolling wheels [rad/s]
# other errors of rolling wheels last so long: they are no independent news
WRONG_FOR_S = 3.0
ABOUT_RADPS = 0.005  # yaw rate of a robot that about stands, over a second
STANDING = 4.0  # standard deviations from the bias within which the robot stands, too


class Gyro(NamedTuple):
    """What is known of a gyro, and of the wheels beside it."""

    stamp_ns: int  # of the newest yaw rate
    rate: float  # that rate [rad/s]
    total: float  # integral of all rates until then [rad]
    since_ns: int  # first yaw rate after the last gap
    period_s: float  # between two yaw rates
    noise: float  # variance of a yaw rate, as told or assumed
    seen: float = 0.0  # variance of yaw rates by their differences
    seen_count: int = 0
    change: float = 0.0  # from the yaw rate before to the newest [rad/s]
    equal: int = 0  # yaw rates in a row that did not change
    refused: int = 0  # in a row
    refused_share: float = 0.0  # of the latest yaw rates
    bias: float = 0.0
    bias_variance: float = BIAS_STD**2
    cross: float = 0.0  # covariance of the robot's heading with the bias
    # Sums of squares and products of turns between odometries, that fade.
    wheels_square: float = 0.0
    product: float = 0.0
    difference_square: float = 0.0
    wheels_turned: float = 0.0  # sum of the sizes [rad]
    # mean square difference of both rates while going straight [rad^2/s^2]
    scatter: float = 0.0
    compared_s: float = 0.0
    # Of the newest odometry that was used; None before.
    odom: Array | None = None  # (3,) its pose, as it was received
    odom_ns: int = 0
    odom_total: float = 0.0  # integral of all rates until then [rad]
    wheels_rate: float = 0.0  # yaw rate of its twist [rad/s]
    # the same before the gyro was `FROZEN` times equal
    wheels_rate_when_equal: float = 0.0

    @property
    def variance(self) -> float:
        """Variance of a yaw rate: as told, unless what is seen differs by far."""
        if self.seen_count < FEWEST_SEEN:
            return max(self.noise, GYRO_STD**2)
        seen = max(self.seen, LEAST_STD**2)
        return self.noise if seen / CLAIM <= self.noise <= seen * CLAIM else seen

    @property
    def slip(self) -> float:
        """Usual error of the wheels' turns, as a share of these."""
        square = self.difference_square + SLIP**2 * SLIP_KNOWN
        return max(LEAST_SLIP, math.sqrt(square / (self.wheels_square + SLIP_KNOWN)))

    @property
    def fits(self) -> bool:
        """False if it is mere noise, or turns unlike the wheels as only a fault explains."""
        if self.seen > GREATEST_VARIANCE or self.refused_share > MOST_REFUSED:
            return False
        if self.wheels_turned < TURN_TO_TELL or self.wheels_square == 0.0:
            return True
        return SLOPES[0] < self.product / self.wheels_square < SLOPES[1]

    def contradicts(self, unbiased: float, by_wheels: float, spread: float) -> bool:
        """True for a turn that a gyro which has not shown yet to be in order is not believed.

        It is of the opposite sign or several times as large as that of the wheels, beyond the
        deviation that a `spread` [rad^2] explains. Later the wheels may have slipped so.
        """
        if self.wheels_turned >= TURN_TO_TELL:
            return False
        margin = STANDING * math.sqrt(spread) + LEAST_CONTRADICTION
        along = unbiased if by_wheels >= 0.0 else -unbiased
        least, most = (slope * abs(by_wheels) for slope in SLOPES)
        return not least - margin <= along <= most + margin

    def total_at(self, time_ns: int) -> float:
        """Integral of all rates until a time, at which the newest rate still holds [rad]."""
        return self.total + self.rate * (time_ns - self.stamp_ns) / NS_PER_S

    def restarted(self) -> "Gyro":
        """Returns what remains known after the clock was set: bias, noise and slip."""
        return self._replace(since_ns=FAR_AHEAD_NS, refused=0)


FAR_AHEAD_NS = 2**62


class Turned(NamedTuple):
    """An odometry whose turn is fused with the gyro's."""

    odom: Array  # (3,) pose on a path of the same displacements
    twist: Array  # (3,)
    gyro: Gyro
    # gained by the heading, beside what the filter adds [rad^2]
    heading_variance: float = 0.0
    # of the twist's yaw rate, as far as it is the gyro's [rad^2/s^2]
    rate_variance: float = 0.0


def believable_variance(variance: float | None) -> float | None:
    """Returns a variance of a yaw rate if it can be right, else None."""
    if variance is None or not 0.0 < variance <= GREATEST_VARIANCE:
        return None
    return max(variance, LEAST_STD**2)


def take_rate(
    gyro: Gyro | None,
    stamp_ns: int,
    rate: float,
    variance: float | None,
    fastest: float,
) -> tuple[Gyro | None, float, bool]:
    """Takes a yaw rate [rad/s] of a robot that turns at most so fast [rad/s].

    Returns what is known then, its squared, normalised difference from what the wheels tell, and
    whether it was used.
    """
    bias = 0.0 if gyro is None else gyro.bias
    if not abs(rate - bias) <= FASTER * fastest + PUSHED_RADPS:
        return (None if gyro is None else _refuse(gyro)), math.inf, False
    noise = believable_variance(variance) or GYRO_STD**2
    if gyro is None:
        return Gyro(stamp_ns, rate, 0.0, stamp_ns, 0.0, noise), 0.0, True
    distance = _distance(gyro, rate)
    passed_s = (stamp_ns - gyro.stamp_ns) / NS_PER_S
    gap = (
        gyro.since_ns > gyro.stamp_ns
        or not 0 < stamp_ns - gyro.stamp_ns <= LONGEST_GAP_NS
    )
    if gap:
        fresh = gyro._replace(
            stamp_ns=stamp_ns,
            rate=rate,
            since_ns=stamp_ns,
            change=0.0,
            equal=0,
            refused=0,
        )
        return fresh, distance, True
    change = rate - gyro.rate
    allowed = (
        ALWAYS_ALLOWED
        + GREATEST_CHANGE * passed_s
        + STANDING * math.sqrt(gyro.variance)
    )
    if abs(change) > allowed and gyro.refused + 1 < PATIENCE:
        return _refuse(gyro), distance, False
    square = (change - gyro.change) ** 2 / 6.0  # of a second difference of white noise
    smoothing = max(SMOOTHING, 1.0 / (gyro.seen_count + 1))
    known = gyro._replace(
        stamp_ns=stamp_ns,
        rate=rate,
        total=gyro.total + 0.5 * (gyro.rate + rate) * passed_s,
        period_s=passed_s
        if gyro.period_s == 0.0
        else 0.9 * gyro.period_s + 0.1 * passed_s,
        noise=noise,
        seen=gyro.seen + smoothing * (square - gyro.seen),
        seen_count=gyro.seen_count + 1,
        change=change,
        equal=gyro.equal + 1 if change == 0.0 else 0,
        refused=0,
        refused_share=(1.0 - SMOOTHING) * gyro.refused_share,
    )
    return known, distance, True


def _refuse(gyro: Gyro) -> Gyro:
    share = gyro.refused_share + SMOOTHING * (1.0 - gyro.refused_share)
    return gyro._replace(refused=gyro.refused + 1, refused_share=share)


def _distance(gyro: Gyro, rate: float) -> float:
    spread = gyro.variance + gyro.bias_variance + (gyro.slip * gyro.wheels_rate) ** 2
    return float((rate - gyro.bias - gyro.wheels_rate) ** 2 / spread)


def turn_odometry(
    gyro: Gyro,
    before: Array,
    odom: Array,
    twist: Array,
    now_ns: int,
    rate_variance: float,
    resting: bool = False,
) -> Turned:
    """Fuses the turn of an odometry, pose (3,) and twist (3,), with the gyro's since the last one.

    `before` (3,) is the pose that was returned for the last one; `rate_variance` that of the yaw
    rate of the twist; `resting` says that the robot stands, as far as is known otherwise. Without
    a gyro in between, or with a faulty one, the wheels' turn is kept.
    """
    last = before if gyro.odom is None else gyro.odom
    step = geometry.log(geometry.between(last, odom))
    here = gyro._replace(
        odom=np.array(odom),
        odom_ns=now_ns,
        odom_total=gyro.total_at(now_ns),
        wheels_rate=float(twist[2]),
    )
    seconds = (now_ns - gyro.odom_ns) / NS_PER_S
    if not _covers(gyro, now_ns) or seconds <= 0.0:
        moved = geometry.compose(before, geometry.exp(step))
        return Turned(moved, twist, here)
    by_gyro = here.odom_total - gyro.odom_total
    by_wheels = float(step[2])
    still = bool((step == 0.0).all() and (twist == 0.0).all())
    here = _compare(here, by_gyro - gyro.bias * seconds, by_wheels, seconds)
    noise = gyro.variance * max(gyro.period_s, 1e-3) * seconds
    spread = noise + gyro.bias_variance * seconds**2
    doubted = not still and here.contradicts(
        by_gyro - gyro.bias * seconds, by_wheels, spread
    )
    if here.equal < FROZEN:
        here = here._replace(wheels_rate_when_equal=here.wheels_rate)
    stuck = abs(here.wheels_rate - here.wheels_rate_when_equal) > CHANGED_RADPS
    if doubted or stuck or not here.fits:
        moved = geometry.compose(before, geometry.exp(step))
        return Turned(moved, twist, here)
    # Wheels may err less than they claim: their scatter beside the gyro is what is seen of it.
    seen_long = here.compared_s > SCATTER_KNOWN_S
    rate_variance = min(rate_variance, here.scatter) if seen_long else rate_variance
    wheels_variance = rate_variance * seconds**2 + (here.slip * by_wheels) ** 2
    if still or resting:
        here = _learn_bias_at_rest(here, by_gyro, seconds, noise, still)
    else:
        here = _learn_bias(here, by_gyro - by_wheels, seconds, noise, wheels_variance)
    unbiased = by_gyro - here.bias * seconds
    spread = noise + here.bias_variance * seconds**2
    # What neither explains is slip: the gyro's noise and bias are known.
    wheels_variance = max(wheels_variance, (unbiased - by_wheels) ** 2 - spread)
    share = wheels_variance / (wheels_variance + spread)
    if still and abs(unbiased) <= STANDING * math.sqrt(spread):
        share = 0.0  # wheels that stand do not turn the robot
    step[2] = share * unbiased + (1.0 - share) * by_wheels
    turned = np.array(twist)
    turned[2] = share * (gyro.rate - here.bias) + (1.0 - share) * twist[2]
    grown = -2.0 * share * here.cross * seconds
    cross = here.cross - share * here.bias_variance * seconds
    moved = geometry.compose(before, geometry.exp(step))
    measured = share**2 * (gyro.variance + here.bias_variance)
    return Turned(moved, turned, here._replace(cross=cross), max(grown, 0.0), measured)


def _covers(gyro: Gyro, now_ns: int) -> bool:
    """True if there were yaw rates from the last odometry until now."""
    if gyro.odom is None or gyro.since_ns > gyro.odom_ns:
        return False
    return 0 <= now_ns - gyro.stamp_ns <= LONGEST_GAP_NS


def _compare(gyro: Gyro, by_gyro: float, by_wheels: float, seconds: float) -> Gyro:
    """Adds turns by both to what is known of how the wheels slip and scatter."""
    kept = math.exp(-seconds / MEMORY_S)
    difference = by_gyro - by_wheels
    turning = abs(by_wheels) > TURNING_RADPS * seconds
    news = 1.0 - kept if gyro.compared_s > 0.0 else 1.0
    scatter = gyro.scatter
    if not turning:
        scatter += news * ((difference / seconds) ** 2 - gyro.scatter)
    return gyro._replace(
        wheels_square=kept * gyro.wheels_square + turning * by_wheels**2,
        product=kept * gyro.product + by_wheels * by_gyro * turning,
        difference_square=kept * gyro.difference_square + turning * difference**2,
        wheels_turned=gyro.wheels_turned + abs(by_wheels),
        scatter=max(scatter, LEAST_STD**2),
        compared_s=gyro.compared_s + seconds,
    )


def _learn_bias_at_rest(
    gyro: Gyro, by_gyro: float, seconds: float, noise: float, still: bool
) -> Gyro:
    """Corrects the bias by how the gyro turned while the robot stood, to the tick or about so."""
    per_second = LEAST_BIAS_STD**2 if still else ABOUT_RADPS**2 / seconds
    variance = gyro.bias_variance + BIAS_WALK**2 * seconds
    return _with_bias(
        gyro, by_gyro / seconds, variance, noise / seconds**2 + per_second
    )


def _learn_bias(
    gyro: Gyro, difference: float, seconds: float, noise: float, wheels_variance: float
) -> Gyro:
    """Corrects the bias by how differently both turned [rad], by little, while the wheels roll."""
    variance = gyro.bias_variance + BIAS_WALK**2 * seconds
    if variance < WHEELS_BIAS**2:  # wheels of unequal size turn a robot so much, too
        return gyro._replace(bias_variance=variance)
    repeated = max(1.0, WRONG_FOR_S / seconds)
    measured = noise / seconds**2 + repeated * wheels_variance / seconds**2
    return _with_bias(gyro, difference / seconds, variance, measured)


def _with_bias(gyro: Gyro, seen: float, variance: float, measured: float) -> Gyro:
    """Corrects a bias by one that was seen, with a variance of `measured`."""
    apart = seen - gyro.bias
    spread = variance + measured
    if apart**2 > STANDING**2 * spread:
        return gyro._replace(
            bias_variance=variance
        )  # it was pushed, or its wheels spin
    gain = variance / spread
    return gyro._replace(
        bias=gyro.bias + gain * apart,
        bias_variance=(1.0 - gain) * variance,
        cross=(1.0 - gain) * gyro.cross,
    )
