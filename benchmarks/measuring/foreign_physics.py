"""Equations of motion of robots that were written for this test alone.

They share nothing with the package's kinematics: forces between wheels and ground, servos of second
order, motors with a torque curve. Each state begins with x, y [m], heading [rad] of the reference
point in the world, and is integrated by Runge and Kutta's method of fourth order.
"""

from __future__ import annotations

import math

import numpy as np

from nics_drl_bridge.geometry import Array
from nics_drl_bridge.kernels import kernel

SKID_STEER, THROTTLE_CAR, TRICYCLE, OMNI, TICKS = range(5)
GRAVITY = 9.81
STATES = 8
Twist = tuple[float, float, float]


@kernel
def _grip(
    slip_x: float, slip_y: float, friction: float, load: float, softness: float
) -> tuple[float, float]:
    """Friction of a wheel, opposite to its slip [m/s], that saturates at friction * load [N]."""
    share = friction * load / math.sqrt(slip_x**2 + slip_y**2 + softness**2)
    return -share * slip_x, -share * slip_y


@kernel
def _drive_skid_steer(s: Array, u: Array, p: Array, out: Array) -> Twist:
    """Four wheels that skid: forces of friction on a body with mass."""
    mass, inertia, front, rear, half_track, friction, softness, lag = p[:8]
    vx = s[3]
    vy = s[4]
    turn = s[5]
    force_x = 0.0
    force_y = 0.0
    torque = 0.0
    for side in range(2):
        y = half_track if side == 0 else -half_track
        for x in (front, -rear):
            load = mass * GRAVITY * 0.5 * (rear if x > 0.0 else front) / (front + rear)
            fx, fy = _grip(
                vx - turn * y - s[6 + side], vy + turn * x, friction, load, softness
            )
            force_x = force_x + fx
            force_y = force_y + fy
            torque += x * fy - y * fx
    out[3] = force_x / mass + turn * vy
    out[4] = force_y / mass - turn * vx
    out[5] = torque / inertia
    out[6] = (u[0] - u[1] * half_track - s[6]) / lag
    out[7] = (u[0] + u[1] * half_track - s[7]) / lag
    return vx, vy, turn


@kernel
def _drive_throttle_car(s: Array, u: Array, p: Array, out: Array) -> Twist:
    """A motor whose pull falls with the speed, a dead zone, drag; a servo, understeer, slip."""
    (
        dead,
        pull,
        top,
        rolling,
        drag,
        wheelbase,
        greatest,
        servo,
        understeer,
        slip,
        yaw_lag,
    ) = p[:11]
    v = s[3]
    angle = s[4]
    turn = s[5]
    beyond = max(abs(u[0]) - dead, 0.0) / (1.0 - dead)
    push = math.copysign(beyond, u[0]) * pull
    out[3] = (
        push
        - pull * beyond * v / top
        - rolling * math.tanh(v / 0.002)
        - drag * v * abs(v)
    )
    out[4] = (greatest * min(max(u[1], -1.0), 1.0) - angle) / servo
    out[5] = (v * math.tan(angle) / (wheelbase + understeer * v * v) - turn) / yaw_lag
    return v, -slip * v * v * turn, turn


@kernel
def _drive_tricycle(s: Array, u: Array, p: Array, out: Array) -> Twist:
    """A driven, steered front wheel: a motor of first order, a damped servo of second."""
    wheelbase, motor, stiffness, damping = p[:4]
    out[3] = (u[0] - s[3]) / motor
    out[4] = s[5]
    out[5] = stiffness * (u[1] - s[4]) - damping * s[5]
    return s[3] * math.cos(s[4]), 0.0, s[3] * math.sin(s[4]) / wheelbase


@kernel
def _drive_omni(s: Array, u: Array, p: Array, out: Array) -> Twist:
    """Three wheels at 120 degrees, each with a motor of its own lag, on unequal radii."""
    arm = p[0]
    vx = 0.0
    vy = 0.0
    turn = 0.0
    for i in range(3):
        at = math.pi / 3.0 + i * 2.0 * math.pi / 3.0
        along_x = -math.sin(at)
        along_y = math.cos(at)
        out[3 + i] = (along_x * u[0] + along_y * u[1] + arm * u[2] - s[3 + i]) / p[
            1 + i
        ]
        speed = p[4 + i] * s[3 + i]
        vx = vx + speed * along_x * 2.0 / 3.0
        vy = vy + speed * along_y * 2.0 / 3.0
        turn += speed / (3.0 * arm)
    return vx, vy, turn


@kernel
def _drive_ticks(s: Array, u: Array, p: Array, out: Array) -> Twist:
    """Two driven wheels whose turned angles [rad] are the last two states."""
    left, right, base, lag = p[:4]
    out[3] = (u[0] - s[3]) / lag
    out[4] = (u[1] - s[4]) / lag
    out[5] = s[3]
    out[6] = s[4]
    return 0.5 * (left * s[3] + right * s[4]), 0.0, (right * s[4] - left * s[3]) / base


@kernel
def _compute_rates(kind: int, s: Array, u: Array, p: Array, out: Array) -> None:
    if kind == SKID_STEER:
        vx, vy, turn = _drive_skid_steer(s, u, p, out)
    elif kind == THROTTLE_CAR:
        vx, vy, turn = _drive_throttle_car(s, u, p, out)
    elif kind == TRICYCLE:
        vx, vy, turn = _drive_tricycle(s, u, p, out)
    elif kind == OMNI:
        vx, vy, turn = _drive_omni(s, u, p, out)
    else:
        vx, vy, turn = _drive_ticks(s, u, p, out)
    c = math.cos(s[2])
    sn = math.sin(s[2])
    out[0] = c * vx - sn * vy
    out[1] = sn * vx + c * vy
    out[2] = turn


@kernel(allocates=True)
def integrate(states: Array, command: Array, kind: int, p: Array, dt: float) -> None:
    """Fills states (T + 1, 8) of which the first is given, under commands (T, C) of `dt` [s]."""
    k1 = np.zeros(STATES)
    k2 = np.zeros(STATES)
    k3 = np.zeros(STATES)
    k4 = np.zeros(STATES)
    for t in range(len(command)):
        s = states[t]
        u = command[t]
        _compute_rates(kind, s, u, p, k1)
        _compute_rates(kind, s + 0.5 * dt * k1, u, p, k2)
        _compute_rates(kind, s + 0.5 * dt * k2, u, p, k3)
        _compute_rates(kind, s + dt * k3, u, p, k4)
        states[t + 1] = s + dt / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
