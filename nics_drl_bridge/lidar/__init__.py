"""Lidar: the exact scanner, and baked tables that replace it (Sec. IV-B)."""
