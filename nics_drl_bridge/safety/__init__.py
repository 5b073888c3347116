"""Rules that stand between a policy and a robot, as pure functions."""
