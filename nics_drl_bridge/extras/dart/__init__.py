"""Robots in DART, Gazebo's default physics engine: wheels with contact, and its own rays."""

from nics_drl_bridge.extensions import require

require("DART", "dartpy")
