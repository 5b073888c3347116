"""Training on many machines with Ray."""
