"""The generated simulator: worlds, motion, collision and lidar, batched."""
