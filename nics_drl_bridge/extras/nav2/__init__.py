"""Nav2's actions, served by a policy."""
