"""Policies map observations to actions: baselines, planners, policy files, training, evaluation."""
