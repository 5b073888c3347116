"""The tables of figures in docs/lidar.md. See tables.py."""

from __future__ import annotations

from measuring.table import Table

SHAPES = {
    "circle": "circle, r 0.15 m",
    "square": "square, 0.3 m",
    "strip": "strip, 0.6 x 0.06 m",
    "mixture": "mixture",
}
PEERS = Table(
    (
        "",
        "scans/s",
        "baked is faster",
        "RMSE against our exact scan",
        "its cost in a step / alone",
    ),
    (
        ("lidar_peers", "baked", "{baked|.1e}", "", "{rmse_m.baked x1000|.1f} mm", ""),
        ("lidar_peers", "exact", "{exact|.1e}", "", "", ""),
        *(
            (
                "lidar_peers",
                title,
                f"{{{name}|,.0f}}",
                f"{{times_as_fast_at_equal_work.{name}|,.0f}} times",
                f"{{rmse_m.{name}|.1g}} m{further}",
                f"{{agreement.{name}|.2f}}",
            )
            for name, title, further in (
                ("ir_sim", "ir-sim 2.12.0", " (its circles are polygons)"),
                ("irsim_x", "irsim-x 1.1.4", ""),
            )
        ),
    ),
)
PAPER_SCANS = {
    "circle": ("57", "330", "0.085", "0.0056"),
    "square": ("3.6", "332", "0.089", "0.0067"),
    "strip": ("4.2", "324", "0.105", "0.0099"),
    "mixture": ("5.7", "339", "0.091", "0.0072"),
}
# The paper's average speeds are harmonic means of its four scenes, its errors arithmetic ones.
PAPER_AVERAGE = ("5.65", "331", "0.0923", "0.00735")
AVERAGE_SCENE = (
    (
        "table2_lidar",
        "average",
        "here",
        "{harmonic_mean scenes.*.exact_scans_per_s|.1e}",
        "{harmonic_mean scenes.*.baked_scans_per_s|.1e}",
        "{mean scenes.*.rmse_m|.4f}",
        "{mean scenes.*.area_rmse_m2|.4f}",
        "{mean scenes.*.share_of_write_limit|.0%}",
        "",
    ),
    (
        "table2_lidar",
        "",
        "nearest row",
        "",
        "",
        "{mean scenes.*.nearest_row_rmse_m|.3f}",
        "{mean scenes.*.nearest_row_area_rmse_m2|.3f}",
        "",
        "",
    ),
    ("table2_lidar", "", "paper", *PAPER_AVERAGE, "", ""),
)
TABLE2 = Table(
    (
        "scene",
        "",
        "scan mode [1/s]",
        "baked [1/s]",
        "RMSE [m]",
        "RMSE of the area [m²]",
        "of the write limit",
        "table",
    ),
    tuple(
        row
        for name, title in SHAPES.items()
        for row in (
            (
                "table2_lidar",
                title,
                "here",
                f"{{scenes.{name}.exact_scans_per_s|.1e}}",
                f"{{scenes.{name}.baked_scans_per_s|.1e}}",
                f"{{scenes.{name}.rmse_m|.4f}}",
                f"{{scenes.{name}.area_rmse_m2|.4f}}",
                f"{{scenes.{name}.share_of_write_limit|.0%}}",
                f"{{table_bytes.{name} x1e-6|.2g}} MB",
            ),
            (
                "table2_lidar",
                "",
                "nearest row",
                "",
                "",
                f"{{scenes.{name}.nearest_row_rmse_m|.3f}}",
                f"{{scenes.{name}.nearest_row_area_rmse_m2|.3f}}",
                "",
                "",
            ),
            ("table2_lidar", "", "paper", *PAPER_SCANS[name], "", ""),
        )
    )
    + AVERAGE_SCENE,
)
TABLE2_HOKUYO = Table(
    (
        "scene",
        "exact [1/s]",
        "baked [1/s]",
        "RMSE [m]",
        "nearest row's",
        "of the write limit",
        "table",
    ),
    tuple(
        (
            "table2_hokuyo",
            title,
            f"{{scenes.{name}.exact_scans_per_s|.1e}}",
            f"{{scenes.{name}.baked_scans_per_s|.1e}}",
            f"{{scenes.{name}.rmse_m|.4f}}",
            f"{{scenes.{name}.nearest_row_rmse_m|.3f}}",
            f"{{scenes.{name}.share_of_write_limit|.0%}}",
            f"{{table_bytes.{name} x1e-6|.2g}} MB",
        )
        for name, title in SHAPES.items()
    ),
)
DENSITIES = ("100x240", "50x240", "100x120")
TABLE3 = Table(
    ("look-up", "distances x rotations", *SHAPES, "worse, on average"),
    (
        *(
            (
                "table3_density",
                title if not k else "",
                density.replace("x", " x "),
                *(f"{{{path}{density}.{name}|{how}}}" for name in SHAPES),
                f"{{times_worse.{key}.{density}|.2f}} times" if k else "",
            )
            for key, title, path, how in (
                ("ours", "here", "", ".4f"),
                ("nearest_row", "nearest row", "nearest_row.", ".3f"),
            )
            for k, density in enumerate(DENSITIES)
        ),
        ("table3_density", "paper", "50 x 240", "", "", "", "", "3.47 times"),
        ("table3_density", "", "100 x 120", "", "", "", "", "little"),
    ),
)
COMPLEXITY = Table(
    ("vertices", *(str(2**power) for power in range(2, 13))),
    tuple(
        ("lidar_complexity", name, *(f"{{{name}_us.{k}|.2g}}" for k in range(11)))
        for name in ("exact", "baked")
    ),
)
MAPS = Table(
    (
        "720 beams, map of 20 m x 20 m at 0.05 m",
        "range [m]",
        "exact [scans/s]",
        "baked [scans/s]",
        "ratio",
        "RMSE [mm]",
    ),
    tuple(
        (
            "map_lidar",
            title,
            f"{{rows.{k}.range_max_m|.0f}}",
            f"{{rows.{k}.exact_scans_per_s|,}}",
            f"{{rows.{k}.baked_scans_per_s|,}}",
            f"{{rows.{k}.ratio|.1f}}",
            f"{{rows.{k}.rmse_m x1000|.1g}}",
        )
        for k, title in enumerate((*("office",) * 2, *("as SLAM leaves it",) * 2))
    ),
)
FIG4 = Table(
    ("", "against scan mode", "[mm]"),
    (
        *(
            ("fig4_pointcloud", title, what, f"{{{path} x1000|{how}}}")
            for title, key, how in (
                ("baked", "baked", ".1f"),
                ("MuJoCo", "mujoco", ".1g"),
            )
            for what, path in (
                ("RMSE of the cloud, to the nearest point", f"cloud_rmse_m.{key}"),
                ("RMSE beam by beam", f"range_rmse_m.{key}"),
            )
        ),
        (
            "fig4_pointcloud",
            "odometry",
            "error of the path",
            "{slam.odometry_error_m x1000|.0f}",
        ),
        (
            "fig4_pointcloud",
            "SLAM",
            "error of the path",
            "{slam.path_error_m x1000|.0f}",
        ),
    ),
)
