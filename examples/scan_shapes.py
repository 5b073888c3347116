"""Scans shapes in a mapped room, looked up and exactly, and says how far the two are apart."""

import numpy as np

from nics_drl_bridge.lidar.maps import load_map
from nics_drl_bridge.lidar.scanner import make_scanner
from nics_drl_bridge.lidar.shapes import Circle, Polygon, Rectangle
from nics_drl_bridge.lidar.spec import load_lidar

shapes = [
    Circle(radius=0.2),
    Rectangle(size=(0.6, 0.4)),
    Polygon(points=((0.0, 0.0), (0.5, 0.0), (0.1, 0.1), (0.0, 0.5))),
]
lidar, room = load_lidar("rplidar_a2"), load_map("room")
robots = room.cell_to_world(np.argwhere(room.distance_field > 0.5)[::400])
robots += np.array([0.013, 0.007])  # from a cell's centre a beam may just touch a corner
poses = np.concatenate([robots, np.zeros((len(robots), 1))], axis=1)
around = np.array([(0.8, 0.3, 0.4), (-0.5, 0.9, 1.0), (0.2, -1.0, 2.0)])

scans = {}
for renderer in ("auto", "exact"):
    scanner = make_scanner(lidar, shapes, renderer, room)
    bodies = scanner.place(shapes, poses[:, None] + around)
    scans[renderer] = np.nan_to_num(scanner.scan(poses, bodies), posinf=lidar.range_max)
off = np.sqrt(np.mean((scans["auto"] - scans["exact"]) ** 2))
print(f"{len(poses)} scans of {lidar.beams} beams, RMSE {1000.0 * off:.1f} mm")
