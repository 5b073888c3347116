"""Detailed robots in MuJoCo: wheels with contact, friction and motors."""
