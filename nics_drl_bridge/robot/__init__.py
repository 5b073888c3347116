"""What a robot is: its specification, its Taylor model, its noise and delays."""
