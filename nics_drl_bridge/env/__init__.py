"""Gymnasium environments: tasks written once, for any backend."""
