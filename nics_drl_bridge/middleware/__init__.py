"""Middleware between a robot's topics and the consumers of its view, independent of ROS."""
