"""Fuses the turns of odometry and a gyro, weighted by their stated and observed variances.

Wheels slip when a robot turns: those of a skid-steer robot may overestimate the turn by
a third. A gyro does not slip, but has noise and a bias that changes slowly. The bias is
estimated while the wheels are at rest and, with less weight, while they roll. The fused
turn replaces that of odometry, in its twist and its relative pose; the wheels'
displacements are kept.
"""

import math
from typing import NamedTuple

import numpy as np

from nics_drl_bridge import geometry
from nics_drl_bridge.geometry import Array
from nics_drl_bridge.interface import NS_PER_S

# Gyro
GYRO_STD = 0.02  # deviation of a yaw rate without a plausible variance [rad/s]
MIN_GYRO_STD = 1e-4  # [rad/s]
MAX_VARIANCE = 1.0  # a larger one means that the rate is unknown [rad^2/s^2]
BIAS_STD = 0.1  # deviation of the bias of a gyro that was never at rest [rad/s]
BIAS_WALK = 1e-4  # random walk of a bias [rad/s / sqrt(s)]
REST_BIAS_STD = (
    3e-4  # deviation of the yaw rate of a robot at rest from the bias [rad/s]
)
VARIANCE_RATIO = 25.0  # factor by which stated and observed variance may differ
MIN_SAMPLES = 30  # yaw rates after which the observed variance counts
SMOOTHING = 0.05  # weight of a new yaw rate in running means
MAX_GAP_NS = 250_000_000  # maximum time between two yaw rates over which they are used
# A gyro is stuck if this many yaw rates are equal while the wheels' rate changes by this [rad/s].
FROZEN_COUNT = 25
FROZEN_CHANGE = 0.1
MAX_ACCELERATION = 40.0  # angular acceleration that no robot exceeds [rad/s^2]
MIN_STEP = 0.3  # change from one yaw rate to the next that is always accepted [rad/s]
# A push may turn a robot at its maximum rate times this factor, plus this rate [rad/s].
RATE_FACTOR = 2.0
PUSH_RATE = 1.0
MAX_REJECTED = 5  # number of consecutive sudden changes, the last of which is accepted
MAX_REJECTED_FRACTION = 0.2  # maximum rejected fraction of the latest yaw rates
# Wheels
ASSUMED_SLIP = 0.1  # fraction of a turn, until more is known
# Weight of that assumption, as a sum of squared turns [rad^2]
ASSUMED_SLIP_WEIGHT = 1e-3
MIN_SLIP_FRACTION = 0.05
MEMORY_S = 30.0  # time constant of slip and scatter
MIN_COMPARED_TURN = (
    0.5  # turn of the wheels before they can be compared with the gyro [rad]
)
# Bounds on the slope of gyro turns over wheel turns; beyond them, the gyro's axis or unit is wrong
MIN_SLOPE = -0.3
MAX_SLOPE = 3.0
CONTRADICTION_MARGIN = 0.005  # tolerance of the turn between two odometries [rad]
TURNING_RATE = 0.1  # slower turns of the wheels do not reveal slip [rad/s]
MIN_COMPARED_S = 5.0  # after which the wheels' scatter is known
WHEELS_BIAS = 0.004  # constant error of rolling wheels [rad/s]
# Other errors of rolling wheels persist this long, so samples within it are not independent.
ERROR_DURATION_S = 3.0
REST_RATE = 0.005  # yaw rate, averaged over a second, of a robot that is roughly at rest [rad/s]
SIGMAS = 4.0  # standard deviations beyond which a difference is significant
NEVER_NS = 2**62


class Gyro(NamedTuple):
    """Estimated errors of a gyro and of the wheels."""

    stamp_ns: int  # stamp of the newest yaw rate
    rate: float  # that rate [rad/s]
    integral: float  # integral of all yaw rates until then [rad]
    since_ns: int  # stamp of the first yaw rate after the last gap
    period_s: float  # mean time between two yaw rates
    noise: float  # variance of a yaw rate, as stated or assumed
    observed: float = 0.0  # variance of yaw rates, from their second differences
    samples: int = 0
    change: float = 0.0  # between the two newest yaw rates [rad/s]
    repeats: int = 0  # consecutive yaw rates that did not change
    rejected: int = 0  # number of consecutive rejected yaw rates
    rejected_fraction: float = 0.0  # fraction of the latest yaw rates
    bias: float = 0.0
    bias_variance: float = BIAS_STD**2
    cross: float = 0.0  # covariance of the robot's heading with the bias
    # Fading sums over turns between odometries: wheels^2, wheels * gyro, (gyro - wheels)^2
    wheels_square: float = 0.0
    product: float = 0.0
    difference_square: float = 0.0
    wheels_turned: float = 0.0  # sum of absolute turns [rad]
    # Mean squared difference of both rates while going straight [rad^2/s^2]
    scatter: float = 0.0
    compared_s: float = 0.0
    # The newest odometry that was used
    odom: Array | None = None  # (3,) its pose as received; None before the first
    odom_ns: int = 0
    odom_integral: float = 0.0  # integral of all yaw rates until then [rad]
    wheels_rate: float = 0.0  # yaw rate of its twist [rad/s]
    # Yaw rate of the wheels before the gyro repeated itself `FROZEN_COUNT` times [rad/s]
    wheels_rate_before: float = 0.0

    @property
    def variance(self) -> float:
        """Variance of a yaw rate: the stated one, unless it is far from the observed one."""
        if self.samples < MIN_SAMPLES:
            return max(self.noise, GYRO_STD**2)
        observed = max(self.observed, MIN_GYRO_STD**2)
        if observed / VARIANCE_RATIO <= self.noise <= observed * VARIANCE_RATIO:
            return self.noise
        return observed

    @property
    def slip(self) -> float:
        """Typical error of a wheel turn, as a fraction of the turn."""
        square = self.difference_square + ASSUMED_SLIP**2 * ASSUMED_SLIP_WEIGHT
        ratio = square / (self.wheels_square + ASSUMED_SLIP_WEIGHT)
        return max(MIN_SLIP_FRACTION, math.sqrt(ratio))

    @property
    def is_plausible(self) -> bool:
        """False if the gyro shows only noise, or differs from the wheels by more than slip."""
        if self.observed > MAX_VARIANCE:
            return False
        if self.rejected_fraction > MAX_REJECTED_FRACTION:
            return False
        if self.wheels_turned < MIN_COMPARED_TURN or self.wheels_square == 0.0:
            return True
        return MIN_SLOPE < self.product / self.wheels_square < MAX_SLOPE

    def has_contradiction(
        self, unbiased: float, by_wheels: float, variance: float
    ) -> bool:
        """Returns True if the turn of an unproven gyro contradicts the wheels' turn.

        The turn then has the opposite sign or is several times as large, more than
        `variance` [rad^2] explains. Once the gyro is proven, such a difference may be
        slip.
        """
        if self.wheels_turned >= MIN_COMPARED_TURN:
            return False
        if by_wheels < 0.0:
            unbiased = -unbiased
        margin = SIGMAS * math.sqrt(variance) + CONTRADICTION_MARGIN
        low = MIN_SLOPE * abs(by_wheels) - margin
        high = MAX_SLOPE * abs(by_wheels) + margin
        return not low <= unbiased <= high

    def integrate_to(self, time_ns: int) -> float:
        """Returns the integral of all rates until a time, with the newest rate held [rad]."""
        return self.integral + self.rate * (time_ns - self.stamp_ns) / NS_PER_S

    def reject(self) -> "Gyro":
        """Returns the estimates after a rejected yaw rate."""
        fraction = self.rejected_fraction + SMOOTHING * (1.0 - self.rejected_fraction)
        return self._replace(rejected=self.rejected + 1, rejected_fraction=fraction)

    def restart(self) -> "Gyro":
        """Returns the estimates that remain valid after the clock was set: bias, noise and slip."""
        return self._replace(since_ns=NEVER_NS, rejected=0)


class FusedOdometry(NamedTuple):
    """An odometry whose turn is fused with the gyro's."""

    odom: Array  # (3,) pose from the wheels' displacements and the fused turns
    twist: Array  # (3,)
    gyro: Gyro
    # Heading variance that the bias adds to the filter's own [rad^2]
    heading_variance: float = 0.0
    # The gyro's part of the variance of the twist's yaw rate [rad^2/s^2]
    rate_variance: float = 0.0


def check_variance(variance: float | None) -> float | None:
    """Returns the variance of a yaw rate, or None if it is implausible."""
    if variance is None or not 0.0 < variance <= MAX_VARIANCE:
        return None
    return max(variance, MIN_GYRO_STD**2)


def take_rate(
    gyro: Gyro | None,
    stamp_ns: int,
    rate: float,
    variance: float | None,
    max_rate: float,
) -> tuple[Gyro | None, float, bool]:
    """Takes a yaw rate [rad/s] of a robot that can turn at `max_rate` [rad/s].

    Returns the updated estimates, the normalised innovation squared with respect to the wheels' yaw
    rate, and True if the yaw rate was used.
    """
    limit = RATE_FACTOR * max_rate + PUSH_RATE
    noise = check_variance(variance) or GYRO_STD**2
    if gyro is None:
        if not abs(rate) <= limit:
            return None, math.inf, False
        return Gyro(stamp_ns, rate, 0.0, stamp_ns, 0.0, noise), 0.0, True
    if not abs(rate - gyro.bias) <= limit:
        return gyro.reject(), math.inf, False
    nis = _compute_nis(gyro, rate)
    passed_ns = stamp_ns - gyro.stamp_ns
    if gyro.since_ns > gyro.stamp_ns or not 0 < passed_ns <= MAX_GAP_NS:
        restarted = gyro._replace(
            stamp_ns=stamp_ns,
            rate=rate,
            since_ns=stamp_ns,
            change=0.0,
            repeats=0,
            rejected=0,
        )
        return restarted, nis, True
    passed_s = passed_ns / NS_PER_S
    change = rate - gyro.rate
    max_change = (
        MIN_STEP + MAX_ACCELERATION * passed_s + SIGMAS * math.sqrt(gyro.variance)
    )
    if abs(change) > max_change and gyro.rejected + 1 < MAX_REJECTED:
        return gyro.reject(), nis, False
    period_s = passed_s
    if gyro.period_s != 0.0:
        period_s = 0.9 * gyro.period_s + 0.1 * passed_s
    # The second difference of white noise has six times its variance.
    square = (change - gyro.change) ** 2 / 6.0
    smoothing = max(SMOOTHING, 1.0 / (gyro.samples + 1))
    updated = gyro._replace(
        stamp_ns=stamp_ns,
        rate=rate,
        integral=gyro.integral + 0.5 * (gyro.rate + rate) * passed_s,
        period_s=period_s,
        noise=noise,
        observed=gyro.observed + smoothing * (square - gyro.observed),
        samples=gyro.samples + 1,
        change=change,
        repeats=gyro.repeats + 1 if change == 0.0 else 0,
        rejected=0,
        rejected_fraction=(1.0 - SMOOTHING) * gyro.rejected_fraction,
    )
    return updated, nis, True


def _compute_nis(gyro: Gyro, rate: float) -> float:
    variance = gyro.variance + gyro.bias_variance + (gyro.slip * gyro.wheels_rate) ** 2
    return float((rate - gyro.bias - gyro.wheels_rate) ** 2 / variance)


def fuse_odometry(
    gyro: Gyro,
    last_fused: Array,
    odom: Array,
    twist: Array,
    now_ns: int,
    rate_variance: float,
    is_at_rest: bool,
) -> FusedOdometry:
    """Fuses the turn since the last odometry, as measured by wheels and gyro.

    The odometry has pose (3,), body twist (3,) and a variance of its yaw rate; `last_fused` (3,) is
    the fused pose of the last one. `is_at_rest` means that all other data show a robot at rest.
    Without a gyro in between, or with a faulty one, the wheels' turn is kept.
    """
    last = last_fused if gyro.odom is None else gyro.odom
    step = geometry.log(geometry.between(last, odom))
    updated = gyro._replace(
        odom=np.array(odom),
        odom_ns=now_ns,
        odom_integral=gyro.integrate_to(now_ns),
        wheels_rate=float(twist[2]),
    )
    seconds = (now_ns - gyro.odom_ns) / NS_PER_S
    by_wheels_alone = FusedOdometry(
        geometry.compose(last_fused, geometry.exp(step)), twist, updated
    )
    if not _covers_odometry(gyro, now_ns) or seconds <= 0.0:
        return by_wheels_alone
    turns = _Turns(
        by_gyro=updated.odom_integral - gyro.odom_integral,
        by_wheels=float(step[2]),
        seconds=seconds,
        gyro_variance=gyro.variance * max(gyro.period_s, 1e-3) * seconds,
        wheels_stand=bool((step == 0.0).all() and (twist == 0.0).all()),
    )
    updated = _compare_turns(updated, turns, gyro.bias)
    if _is_faulty(updated, turns, gyro):
        return by_wheels_alone._replace(gyro=updated)
    # The wheels may err less than stated; their scatter relative to the gyro shows how much.
    if updated.compared_s > MIN_COMPARED_S:
        rate_variance = min(rate_variance, updated.scatter)
    wheels_variance = rate_variance * seconds**2 + (updated.slip * turns.by_wheels) ** 2
    if turns.wheels_stand or is_at_rest:
        updated = _learn_bias_at_rest(updated, turns)
    else:
        updated = _learn_bias(updated, turns, wheels_variance)
    weight = _weigh_gyro(updated, turns, wheels_variance)
    unbiased = turns.by_gyro - updated.bias * seconds
    step[2] = weight * unbiased + (1.0 - weight) * turns.by_wheels
    fused_twist = np.array(twist)
    fused_twist[2] = weight * (gyro.rate - updated.bias) + (1.0 - weight) * twist[2]
    return FusedOdometry(
        odom=geometry.compose(last_fused, geometry.exp(step)),
        twist=fused_twist,
        gyro=updated._replace(
            cross=updated.cross - weight * updated.bias_variance * seconds
        ),
        heading_variance=max(-2.0 * weight * updated.cross * seconds, 0.0),
        rate_variance=weight**2 * (gyro.variance + updated.bias_variance),
    )


class _Turns(NamedTuple):
    """Turns from one odometry to the next."""

    by_gyro: float  # integral of the yaw rates, with their bias [rad]
    by_wheels: float  # [rad]
    seconds: float
    gyro_variance: float  # of the gyro's turn, without that of its bias [rad^2]
    wheels_stand: bool


def _is_faulty(gyro: Gyro, turns: _Turns, previous: Gyro) -> bool:
    """Returns True if the gyro is stuck, implausible, or contradicts the wheels.

    `previous` holds the estimates before this odometry, whose bias these turns have not changed.
    """
    wheels_change = abs(gyro.wheels_rate - gyro.wheels_rate_before)
    if wheels_change > FROZEN_CHANGE or not gyro.is_plausible:
        return True
    if turns.wheels_stand:
        return False
    unbiased = turns.by_gyro - previous.bias * turns.seconds
    variance = turns.gyro_variance + previous.bias_variance * turns.seconds**2
    return gyro.has_contradiction(unbiased, turns.by_wheels, variance)


def _weigh_gyro(gyro: Gyro, turns: _Turns, wheels_variance: float) -> float:
    """Returns the weight of the gyro's turn against that of the wheels, from 0 to 1."""
    unbiased = turns.by_gyro - gyro.bias * turns.seconds
    gyro_variance = turns.gyro_variance + gyro.bias_variance * turns.seconds**2
    if turns.wheels_stand and abs(unbiased) <= SIGMAS * math.sqrt(gyro_variance):
        return 0.0  # wheels at rest do not turn the robot
    # A difference beyond the gyro's known noise and bias is slip.
    slip_variance = (unbiased - turns.by_wheels) ** 2 - gyro_variance
    wheels_variance = max(wheels_variance, slip_variance)
    return wheels_variance / (wheels_variance + gyro_variance)


def _covers_odometry(gyro: Gyro, now_ns: int) -> bool:
    """Returns True if yaw rates cover the time from the last odometry until now."""
    if gyro.odom is None or gyro.since_ns > gyro.odom_ns:
        return False
    return 0 <= now_ns - gyro.stamp_ns <= MAX_GAP_NS


def _compare_turns(gyro: Gyro, turns: _Turns, bias: float) -> Gyro:
    """Updates the estimates of the wheels' slip and scatter from both turns."""
    decay = math.exp(-turns.seconds / MEMORY_S)
    by_wheels = turns.by_wheels
    by_gyro = turns.by_gyro - bias * turns.seconds
    difference = by_gyro - by_wheels
    is_turning = abs(by_wheels) > TURNING_RATE * turns.seconds
    weight = 1.0 - decay if gyro.compared_s > 0.0 else 1.0
    scatter = gyro.scatter
    if not is_turning:
        scatter += weight * ((difference / turns.seconds) ** 2 - gyro.scatter)
    wheels_rate_before = gyro.wheels_rate_before
    if gyro.repeats < FROZEN_COUNT:
        wheels_rate_before = gyro.wheels_rate
    return gyro._replace(
        wheels_square=decay * gyro.wheels_square + is_turning * by_wheels**2,
        product=decay * gyro.product + by_wheels * by_gyro * is_turning,
        difference_square=decay * gyro.difference_square + is_turning * difference**2,
        wheels_turned=gyro.wheels_turned + abs(by_wheels),
        scatter=max(scatter, MIN_GYRO_STD**2),
        compared_s=gyro.compared_s + turns.seconds,
        wheels_rate_before=wheels_rate_before,
    )


def _learn_bias_at_rest(gyro: Gyro, turns: _Turns) -> Gyro:
    """Corrects the bias by the gyro's turn while the robot stood still, or nearly so."""
    seconds = turns.seconds
    rest_variance = REST_BIAS_STD**2 if turns.wheels_stand else REST_RATE**2 / seconds
    variance = gyro.bias_variance + BIAS_WALK**2 * seconds
    measured_variance = turns.gyro_variance / seconds**2 + rest_variance
    return _correct_bias(gyro, turns.by_gyro / seconds, variance, measured_variance)


def _learn_bias(gyro: Gyro, turns: _Turns, wheels_variance: float) -> Gyro:
    """Corrects the bias slightly, by the difference of both turns, while the wheels roll."""
    seconds = turns.seconds
    variance = gyro.bias_variance + BIAS_WALK**2 * seconds
    if variance < WHEELS_BIAS**2:  # unequal wheel sizes also turn a robot that fast
        return gyro._replace(bias_variance=variance)
    repeated = max(1.0, ERROR_DURATION_S / seconds)
    turn_variance = turns.gyro_variance + repeated * wheels_variance
    measured_variance = turn_variance / seconds**2
    difference = turns.by_gyro - turns.by_wheels
    return _correct_bias(gyro, difference / seconds, variance, measured_variance)


def _correct_bias(
    gyro: Gyro, measured: float, variance: float, measured_variance: float
) -> Gyro:
    """Corrects the bias, whose variance is `variance`, by a measured bias [rad/s]."""
    innovation = measured - gyro.bias
    total = variance + measured_variance
    if innovation**2 > SIGMAS**2 * total:
        # The robot was pushed, or its wheels spin.
        return gyro._replace(bias_variance=variance)
    gain = variance / total
    return gyro._replace(
        bias=gyro.bias + gain * innovation,
        bias_variance=(1.0 - gain) * variance,
        cross=(1.0 - gain) * gyro.cross,
    )
