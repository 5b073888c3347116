"""A skid-steer that slips, by its own arithmetic: odometry turns too far, the gyro drifts."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

OVER_REPORTED = 1.3  # of odometry's turns, relative to the true ones
BIAS = 0.02  # of the gyro, rad/s
GYRO_NOISE = 0.004  # rad/s, at 100 Hz
BIAS_WALK = 3e-5  # rad/s / sqrt(s)
LAG_S = 0.15  # of speed and of turn rate
STEP_S = 0.01
ODOM_EVERY = 2  # steps
REST_S = 3.0


@dataclass(frozen=True)
class SlippingDrive:
    """What was sent, what was measured, and what was true."""

    t: np.ndarray  # (T,) [s], every step
    command: np.ndarray  # (T, 2) speed, turn rate
    truth: np.ndarray  # (T, 3) pose
    gyro: np.ndarray  # (T,) yaw rate with bias and noise
    odom_t: np.ndarray  # (O,)
    odom: np.ndarray  # (O, 3) pose by the wheels
    odom_twist: np.ndarray  # (O, 3)


def drive_skid_steer(
    rng: np.random.Generator,
    duration: float = 120.0,
    over_reported: float = OVER_REPORTED,
    bias: float = BIAS,
    hold: float = 1.0,
    rest_s: float = REST_S,
    noise: float = GYRO_NOISE,
) -> SlippingDrive:
    """Drives random commands after a rest, as Euler steps of a centimetre at most."""
    count = round(duration / STEP_S)
    t = np.arange(count) * STEP_S
    held = rng.uniform([-0.2, -1.0], [0.8, 1.0], (int(duration / hold) + 1, 2))
    command = held[(t / hold).astype(int)]
    command[t < rest_s] = 0.0
    motion = np.zeros((count, 2))  # of the wheels: speed, turn rate
    for k in range(1, count):
        motion[k] = motion[k - 1] + (command[k - 1] - motion[k - 1]) * STEP_S / LAG_S
    true_rate = motion[:, 1] / over_reported
    truth = _integrate(motion[:, 0], true_rate)
    wandering = np.cumsum(rng.normal(0.0, BIAS_WALK * np.sqrt(STEP_S), count))
    gyro = true_rate + bias + wandering + rng.normal(0.0, noise, count)
    wheels = _integrate(motion[:, 0], motion[:, 1])
    some = slice(None, None, ODOM_EVERY)
    twist = np.stack([motion[:, 0], np.zeros(count), motion[:, 1]], axis=1)
    return SlippingDrive(t, command, truth, gyro, t[some], wheels[some], twist[some])


def _integrate(speed: np.ndarray, rate: np.ndarray) -> np.ndarray:
    heading = np.concatenate([[0.0], np.cumsum(rate[:-1] * STEP_S)])
    middle = heading + 0.5 * rate * STEP_S
    x = np.concatenate([[0.0], np.cumsum(speed[:-1] * np.cos(middle[:-1]) * STEP_S)])
    y = np.concatenate([[0.0], np.cumsum(speed[:-1] * np.sin(middle[:-1]) * STEP_S)])
    return np.stack([x, y, heading], axis=1)
