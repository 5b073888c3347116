"""The robot: its specification, Taylor model, noise and delays."""

DEFAULT_ROBOT = "differential"  # the shipped robot that is used if none is given
