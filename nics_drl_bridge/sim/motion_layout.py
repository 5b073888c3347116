"""Columns of the arrays that tell how obstacles move; `motion.py` says what they mean."""

from __future__ import annotations

# A row of a plan (K, P): how an obstacle moves.
(
    KIND, SPEED_LOW, SPEED_HIGH, FIRST, COUNT, LOOP, PAUSE,
    RELAXATION, REPULSION, RANGE, WALL_REPULSION, WALL_RANGE, FORESIGHT, VIEW, BEHIND,
    FLUCTUATION,
) = range(16)  # fmt: skip
PLAN = 16

# Values of the column KIND.
STILL, WANDER, PATROL, PEDESTRIAN = range(4)

# What an obstacle remembers, a row of marks (N, K, F).
SPEED, VX, VY, DIRECTION, AIM, GOAL_X, GOAL_Y, UNTIL, INDEX, WAY, REST = range(11)
MARK = 11
