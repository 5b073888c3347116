"""The robot: its specification, its Taylor model, its noise and delays."""
