"""Detailed robots in DART, Gazebo's default physics engine."""
