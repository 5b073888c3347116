"""Models of entities to spawn, from YAML or SDF: shapes and their poses in the entity."""

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple
from xml.etree import ElementTree

from pydantic import Field, model_validator

from nics_drl_bridge.config import Schema, parse_yaml, validate
from nics_drl_bridge.errors import BridgeError, ConfigError
from nics_drl_bridge.lidar.shapes import Shape
from nics_drl_bridge.sim.sdf import AssetsError, Placed, SdfError, read_sdf, root_of
from nics_drl_bridge.sim.world import Pose

HEIGHT = 0.2  # height at which SDF bodies count, as in `nics world import` [m]
MOST_PARTS = 100
TEXT = "resource_string"  # how errors name a text without a file


class ModelFile(Schema):
    """Keys of an entity's YAML file; a single shape may stand alone, without these keys."""

    name: str = ""
    description: str = ""  # for people, like the tags
    tags: tuple[str, ...] = ()
    shapes: tuple[Shape, ...] = Field(min_length=1, max_length=MOST_PARTS)
    # pose of each shape in the entity [m, m, rad]; at its origin by default
    at: tuple[Pose, ...] = ()

    @model_validator(mode="after")
    def _one_each(self) -> "ModelFile":
        if self.at and len(self.at) != len(self.shapes):
            raise ValueError(
                f"at must hold {len(self.shapes)} poses, one for each shape"
            )
        return self


class Model(NamedTuple):
    """An entity to spawn."""

    name: str
    parts: tuple[Placed, ...]


def model_of_yaml(text: str, source: str = TEXT) -> Model:
    """Read an entity from YAML: the keys of `ModelFile` or of one shape. Raises ConfigError."""
    content = parse_yaml(text, source)
    if "kind" in content:
        content = {"shapes": [content]}
    file = validate(content, ModelFile, source)
    at = file.at or ((0.0, 0.0, 0.0),) * len(file.shapes)
    return Model(file.name, tuple(zip(file.shapes, at, strict=True)))


def model_of_sdf(text: str, z: float, source: str = TEXT) -> Model:
    """Read an entity from SDF, whose origin is spawned at a height z [m].

    Raises ConfigError unless the text is SDF with one model of known shapes, AssetsError for a mesh
    or a missing file, BridgeError for too many shapes.
    """
    with write_file(text, source) as file:
        root = root_of(file)  # refuses XML entities that grow
    models = root.findall("model")
    if len(models) != 1 or root.find("world") is not None:
        raise ConfigError(
            f"{source}: holds {len(models)} models; give one <model>, no <world>."
        )
    pose = models[0].find("pose")
    if pose is not None:
        models[0].remove(pose)  # it is spawned where the request says
    with write_file(ElementTree.tostring(root, encoding="unicode"), source) as file:
        try:
            standing = read_sdf(file, HEIGHT - z)
        except AssetsError:
            raise
        except ConfigError:  # too low to be cut at that height
            standing = read_sdf(file, 0.0)
    if len(standing.placed) > MOST_PARTS:
        raise BridgeError(f"{source}: holds more than {MOST_PARTS} shapes; split it.")
    return Model(models[0].get("name", ""), standing.placed)


@contextmanager
def write_file(text: str, source: str = TEXT) -> Iterator[Path]:
    """Yield a temporary file with a text; errors name `source` instead of its path."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "text.sdf"
        file.write_text(text, encoding="utf-8")
        try:
            yield file
        except SdfError as error:
            if error.file == file:
                error.reword(f"{source}{error.rest}")
            raise
