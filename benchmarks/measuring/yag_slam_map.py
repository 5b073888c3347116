"""Makes a map with yag-slam, in an environment of its own: see fig4_pointcloud.py.

Reads ranges and odometry from an `.npz` file; writes corrected poses and the map to another.
"""

import sys

import numpy as np
from yag_slam.graph_slam import GraphSlam
from yag_slam.models import LocalizedRangeScan
from yag_slam.scan_matching import Scan2DMatcherCpp

RESOLUTION = 0.05


def main() -> None:
    """Feeds one scan after the other."""
    with np.load(sys.argv[1]) as given:
        ranges, odometry, angles, limits = (
            given[name] for name in ("ranges", "odometry", "angles", "limits")
        )
    slam = GraphSlam(Scan2DMatcherCpp({}), Scan2DMatcherCpp({}, loop=True))
    step = float(angles[1] - angles[0])
    far = float(limits[1])
    for scan, pose in zip(ranges, odometry):  # noqa: B905
        scan = np.where(np.isfinite(scan), scan, 2.0 * far)
        slam.process_scan(
            LocalizedRangeScan(
                scan,
                float(angles[0]),
                float(angles[-1]),
                step,
                float(limits[0]),
                far,
                far,
                *map(float, pose),
            )
        )
    slam.run_opt()
    corrected = [vertex.obj.corrected_pose for vertex in slam.graph.vertices]
    grid = slam.make_occupancy_grid(RESOLUTION, far)
    np.savez(
        sys.argv[2],
        poses=np.array([(pose.x, pose.y, pose.euler[-1]) for pose in corrected]),
        image=np.array(grid.image),
        origin=np.array([grid.offset.x, grid.offset.y]),
        resolution=RESOLUTION,
    )


if __name__ == "__main__":
    main()
