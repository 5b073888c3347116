"""Drives as data: recordings, readers of every format, and how to excite a robot."""
