"""What `nics bake` does: shapes from where they stand, a density, a table on disk."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from nics_drl_bridge.config import validate
from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.files import check_above, write_bytes
from nics_drl_bridge.generator import footprint_shape
from nics_drl_bridge.lidar.bake import bake
from nics_drl_bridge.lidar.budget import choose, expected_rmse, parse_size
from nics_drl_bridge.lidar.sensor_models import load_sensor_models
from nics_drl_bridge.lidar.shapes import Shape, describe, load_shapes
from nics_drl_bridge.lidar.spec import LidarSpec, load_lidar
from nics_drl_bridge.lidar.table import Density, LidarTable
from nics_drl_bridge.robot.spec import load_robot
from nics_drl_bridge.sim.world import load_world

Told = Callable[[str, int, int], None]
"""Called with what is being done, how much of it, and of how much; 0 where that is not known."""


@dataclass(frozen=True)
class BakeOrder:
    """What is to be baked.

    Attributes:
        lidar: name or YAML file.
        world: whose obstacles, name or YAML file.
        shapes: a YAML file of them.
        robot: whose footprint, name or YAML file.
        budget: greatest memory, as text.
        density: keys of `Density`, instead of a budget.
        out: the file to write.
        sensor_model: a YAML file of it, in place of that of the lidar.
    """

    lidar: str = "paper"
    world: str | None = None
    shapes: Path | None = None
    robot: str | None = None
    budget: str | None = None
    density: Mapping[str, int] = field(default_factory=dict)
    out: Path = Path("lidar_table.npz")
    sensor_model: Path | None = None

    def spec(self) -> LidarSpec:
        """The lidar, with the sensor model to bake in."""
        spec = load_lidar(self.lidar)
        if self.sensor_model is None:
            return spec
        return spec.model_copy(update={"sensor_model": load_sensor_models(self.sensor_model)})

    def all_shapes(self) -> tuple[Shape, ...]:
        """Each shape once. Raises ConfigError when there is none."""
        shapes: list[Shape] = []
        if self.world is not None:
            shapes += load_world(self.world).shapes
        if self.shapes is not None:
            shapes += load_shapes(self.shapes)
        if self.robot is not None:
            shapes.append(footprint_shape(load_robot(self.robot)))
        if not shapes:
            raise ConfigError("there is nothing to bake; give --world, --shapes or --robot.")
        return tuple(dict.fromkeys(shapes))


def run(order: BakeOrder, told: Told) -> list[str]:
    """Bakes a table and writes it.

    Returns:
        What to tell the user.

    Raises:
        ConfigError: something of the order is wrong.
    """
    if order.out.is_dir():
        raise ConfigError(f"{order.out}: is a folder; give the name of a file.")
    check_above(order.out)
    if order.budget is not None and order.density:
        raise ConfigError("--budget finds the density; leave out either it or the density.")
    spec, shapes = order.spec(), order.all_shapes()
    begin = time.perf_counter()
    table, rmse = _bake(order, spec, shapes, told)
    took = time.perf_counter() - begin
    content = table.dump()
    write_bytes(order.out, content)
    density = table.density
    return [
        f"lidar           {spec.name}, {spec.beams} beams, to {spec.range_max:g} m",
        *(f"sensor model    {model}" for model in spec.sensor_model),
        *(f"shape           {describe(shape)}" for shape in shapes),
        f"density         {density.distances} distances x {density.rotations} rotations, "
        f"{density.phases} points per beam",
        f"expected RMSE   {rmse:.5f} m among ten obstacles, over all beams",
        f"size            {len(content) / 1e6:.2f} MB",
        f"time            {took:.1f} s",
        f"table written to {order.out}",
    ]


def _bake(
    order: BakeOrder, spec: LidarSpec, shapes: tuple[Shape, ...], told: Told
) -> tuple[LidarTable, float]:
    if order.budget is not None:
        size = parse_size(order.budget)
        choice = choose(spec, shapes, size, lambda density: told(f"trying {density}", 0, 0))
        return choice.table, choice.rmse
    default = {"phases": Density.for_beams(spec.angle_increment).phases}
    density = validate(default | dict(order.density), Density, "density")
    table = bake(spec, shapes, density, progress=lambda done, total: told("baking", done, total))
    return table, expected_rmse(spec, table)
