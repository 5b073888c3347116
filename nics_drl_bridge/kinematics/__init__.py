"""Kinematics: robots, recordings, and the Taylor model that is fitted to them (Sec. IV-A)."""
