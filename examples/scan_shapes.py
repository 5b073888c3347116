"""Scan shapes in a mapped room by look-up and exactly, and compare the two."""

from pathlib import Path

import numpy as np

from nics_drl_bridge.lidar.maps import load_map
from nics_drl_bridge.lidar.scanner import make_scanner
from nics_drl_bridge.lidar.shapes import Circle, Polygon, Rectangle
from nics_drl_bridge.lidar.spec import load_lidar
from nics_drl_bridge.style import make_panels, render_png

SHAPES = [
    Circle(radius=0.2),
    Rectangle(size=(0.6, 0.4)),
    Polygon(points=((0.0, 0.0), (0.5, 0.0), (0.1, 0.1), (0.0, 0.5))),
]
# x [m], y [m], heading [rad] of each shape around the robot
AROUND = np.array([(0.8, 0.3, 0.4), (-0.5, 0.9, 1.0), (0.2, -1.0, 2.0)])


def main() -> None:
    lidar = load_lidar("rplidar_a2")
    room = load_map("room")
    robots = room.cell_to_world(np.argwhere(room.distance_field > 0.5)[::400])
    # away from cell centres, where a beam may just touch a corner
    robots += np.array([0.013, 0.007])
    poses = np.concatenate([robots, np.zeros((len(robots), 1))], axis=1)
    scans = {}
    for renderer in ("auto", "exact"):
        scanner = make_scanner(lidar, SHAPES, renderer, room)
        bodies = scanner.place(SHAPES, poses[:, None] + AROUND)
        scans[renderer] = np.nan_to_num(
            scanner.scan(poses, bodies), posinf=lidar.range_max
        )
    off = np.sqrt(np.mean((scans["auto"] - scans["exact"]) ** 2))
    print(f"{len(poses)} scans of {lidar.beams} beams, RMSE {1000.0 * off:.1f} mm")

    figure, grid = make_panels(1, 3, (9.0, 3.4))
    rays = np.stack([np.cos(lidar.angles), np.sin(lidar.angles)], axis=1)
    for axes, at, ranges in zip(grid, robots, scans["auto"], strict=False):
        hits = (at + ranges[:, None] * rays)[ranges < lidar.range_max]
        axes.plot(*hits.T, ".", markersize=1.5)
        axes.plot(*at, "o")
        axes.set(aspect="equal", xlabel="x [m]", ylabel="y [m]")
    Path("scan_shapes.png").write_bytes(render_png(figure))


if __name__ == "__main__":
    main()
