"""Detailed robots in MuJoCo: wheels with contact, friction and motors."""

from nics_drl_bridge.extensions import require

require("MuJoCo", "mujoco")
