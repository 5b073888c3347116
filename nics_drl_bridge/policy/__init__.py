"""Policies: from observation to action, their training and their evaluation."""
