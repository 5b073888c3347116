"""Policies: from observation to action, and how good they are."""
