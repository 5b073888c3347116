"""Rules between a policy and a robot, as pure functions of (time, state, inputs)."""
