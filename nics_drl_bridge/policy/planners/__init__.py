"""Planners: the local map, and model predictive path integral control."""
