"""Gymnasium environments: tasks written once, over any backend."""
