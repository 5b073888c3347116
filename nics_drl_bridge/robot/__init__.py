"""The robot: its specification, its Taylor model, its noise and delays."""

DEFAULT_ROBOT = "differential"  # the shipped robot wherever none is named or told
