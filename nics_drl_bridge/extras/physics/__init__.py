"""Common parts of wheeled robots with contact, for any physics engine."""
