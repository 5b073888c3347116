"""Gazebo worlds in SDF (http://sdformat.org): the obstacles at a height above ground.

Only collision geometry is read, since that is what a robot can touch. Poses of models,
links, frames and includes are composed in 3D; the bodies are then cut by a plane at the
height of the lidar. As in Gazebo classic, the poses of a saved `<state>` replace those
of the models.
"""

import math
import os
from collections.abc import Iterator
from fnmatch import fnmatch
from functools import cache
from itertools import combinations, product
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree.ElementTree import Element, TreeBuilder
from xml.parsers import expat

import numpy as np
import scipy  # its parts load slowly, when used
from pydantic import ValidationError

from nics_drl_bridge import geometry
from nics_drl_bridge.arguments import check_path
from nics_drl_bridge.config import check_no_device
from nics_drl_bridge.errors import ConfigError, suggest
from nics_drl_bridge.lidar.arrays import Array
from nics_drl_bridge.lidar.shapes import (
    FARTHEST,
    LARGEST,
    MOST_CORNERS,
    SMALLEST,
    Circle,
    Polygon,
    Rectangle,
    Shape,
    find_convex_hull,
)
from nics_drl_bridge.sim.world import MOST_OBSTACLES, Obstacles, Region

TILT = 1e-3  # up to this angle [rad], 1 mm per metre, a body counts as upright
DIGITS = 6  # shapes and poses are rounded to a micrometre
AROUND = 1.0  # margin of the bounds around starts and goals [m]


class ShapelessError(ValueError):
    """The section of a body is no shape of a world; the text names the body."""

    def __init__(self, body: str, missing: bool = False) -> None:
        super().__init__(body)
        self.missing = missing  # its file is missing


_Cut = tuple[Shape, float, float, float] | None  # shape and pose before rounding


class Box(NamedTuple):
    """A box centred at its own origin."""

    size: tuple[float, ...]  # along x, y, z [m]

    def cut(self, pose: Array, up: float) -> _Cut:
        """See `section`; `up` is the height of the plane above the origin [m]."""
        vertical = _find_vertical_axis(pose)
        if vertical is None:
            return self._cut_leaning(pose, up)
        if not abs(up) < self.size[vertical] / 2.0:
            return None
        along, across = (axis for axis in range(3) if axis != vertical)
        return _make_rectangle(pose, along, self.size[along], self.size[across])

    def _cut_leaning(self, pose: Array, up: float) -> _Cut:
        """Return the convex polygon of the points where the plane cuts the edges."""
        signs = np.array(list(product((-0.5, 0.5), repeat=3)))
        corners = signs * self.size @ pose[:3, :3].T  # around the box's middle
        cuts = []
        for a, b in combinations(range(8), 2):
            if np.count_nonzero(signs[a] != signs[b]) > 1:
                continue  # not an edge
            below = corners[a, 2] - up
            above = corners[b, 2] - up
            if below * above < 0.0:
                share = below / (below - above)
                cuts.append(corners[a] + share * (corners[b] - corners[a]))
        hull = find_convex_hull(np.array(cuts)[:, :2]) if cuts else np.zeros((0, 2))
        if len(hull) < 3 or np.ptp(hull, axis=0).min() < SMALLEST:
            return None
        return _make_polygon(hull), pose[0, 3], pose[1, 3], 0.0


class Cylinder(NamedTuple):
    """A cylinder along its own z, centred at its origin."""

    radius: float  # [m]
    length: float  # [m]

    def cut(self, pose: Array, up: float) -> _Cut:
        """See `section`; `up` is the height of the plane above the origin [m]."""
        if _find_vertical_axis(pose) == 2:
            is_cut = abs(up) < self.length / 2.0
            return _make_disc(pose, self.radius**2) if is_cut else None
        if abs(pose[2, 2]) >= math.sin(TILT):
            raise ShapelessError("a tilted cylinder")
        width2 = self.radius**2 - up**2
        if width2 <= 0.0:
            return None
        return _make_rectangle(pose, 2, self.length, 2.0 * math.sqrt(width2))


class Capsule(NamedTuple):
    """A cylinder with a hemisphere at either end."""

    radius: float  # [m]
    length: float  # of the cylinder alone [m]

    def cut(self, pose: Array, up: float) -> _Cut:
        """See `section`; `up` is the height of the plane above the origin [m]."""
        if _find_vertical_axis(pose) != 2:
            raise ShapelessError("a tilted capsule")
        beyond = max(abs(up) - self.length / 2.0, 0.0)
        return _make_disc(pose, self.radius**2 - beyond**2)


class Sphere(NamedTuple):
    """A sphere around its own origin."""

    radius: float  # [m]

    def cut(self, pose: Array, up: float) -> _Cut:
        """See `section`; `up` is the height of the plane above the origin [m]."""
        return _make_disc(pose, self.radius**2 - up**2)


class Prism(NamedTuple):
    """An outline extruded upwards from its own z = 0."""

    points: tuple[tuple[float, ...], ...]  # x, y of the corners [m]
    height: float  # [m]

    def cut(self, pose: Array, up: float) -> _Cut:
        """See `section`; `up` is the height of the plane above the origin [m]."""
        if _find_vertical_axis(pose) != 2:
            raise ShapelessError("a tilted polyline")
        upwards = float(np.sign(pose[2, 2]))
        if not 0.0 < up * upwards < self.height:
            return None
        polygon = _make_polygon(np.array(self.points) * (1.0, upwards))
        return polygon, pose[0, 3], pose[1, 3], _find_heading(pose, 0)


Solid = Box | Cylinder | Capsule | Sphere | Prism
Placed = tuple[Shape, tuple[float, float, float]]  # a shape and its pose in the plane


class Standing(NamedTuple):
    """Shapes in a field at the height of a plane."""

    placed: tuple[Placed, ...]
    left_out: tuple[str, ...]  # a clause for each model that a world can't contain

    @property
    def obstacles(self) -> tuple[Obstacles, ...]:
        """Groups of obstacles for a `World`, one group per shape."""
        groups: dict[Shape, list[tuple[float, float, float]]] = {}
        for shape, pose in self.placed:
            groups.setdefault(shape, []).append(pose)
        return tuple(
            Obstacles(shapes=(shape,), at=tuple(at)) for shape, at in groups.items()
        )

    def bounds(self, *places: tuple[float, ...]) -> Region:
        """Return the smallest field around all shapes, and 1 m around places [m]."""
        around = AROUND * np.array([(-1.0, -1.0), (1.0, 1.0)])
        corners = [around + place[:2] for place in places]
        for shape, pose in self.placed:
            outline = geometry.rotate(shape.outline, pose[2])
            corners.append(
                (outline if len(outline) else shape.radius / AROUND * around) + pose[:2]
            )
        points = np.concatenate(corners)
        x1, y1 = (np.floor(points.min(axis=0) * 1e3) / 1e3).tolist()
        x2, y2 = (np.ceil(points.max(axis=0) * 1e3) / 1e3).tolist()
        return x1, y1, x2, y2


MOST_BYTES = 2**24  # limit of a file; the largest saved worlds have a few megabytes
MOST_MODELS = 20_000  # including included models
# versions of SDF
OLDEST = (1, 4)
NEWEST = (1, 12)
PATHS = "GZ_SIM_RESOURCE_PATH", "IGN_GAZEBO_RESOURCE_PATH", "GAZEBO_MODEL_PATH"
HARMLESS = "sun", "ground_plane"  # included in most worlds, but no obstacles
MOVING = {
    "actor": "an actor, which follows a script",
    "population": "a population of models",
}
POSE = {"relative_to", "frame", "degrees", "rotation_format"}  # attributes
NUMBERS = {"euler_rpy": 6, "quat_xyzw": 7}  # of a pose, by its rotation_format


class SdfError(ConfigError):
    """An SDF file is wrong; `rest` continues the sentence after the file's path."""

    def __init__(self, file: Path, rest: str) -> None:
        super().__init__(f"{file}{rest}")
        self.file = file
        self.rest = rest


class AssetsError(SdfError):
    """An SDF file has a shape that worlds do not support, or names a missing file."""

    def __init__(self, file: Path, rest: str, missing: bool = False) -> None:
        super().__init__(file, rest)
        self.missing = missing  # True for a missing file


class Where(NamedTuple):
    """A place in an SDF file."""

    file: Path
    element: str = ""  # model and element, including the separator before them

    def at(self, element: str) -> "Where":
        """Return the place of an element within this one."""
        return Where(self.file, self.element + element)

    def error(self, rest: str) -> SdfError:
        """Return an error that names this place."""
        return SdfError(self.file, self.element + rest)


class _Order:
    """Names to leave out, files opened so far, and number of models so far."""

    def __init__(self, without: tuple[str, ...]) -> None:
        self._without = without
        self._models = 0
        self.root = cache(root_of)  # of a file

    def takes(self, name: str) -> bool:
        return not any(fnmatch(name, pattern) for pattern in self._without)

    def count(self, file: Path) -> None:
        self._models += 1
        if self._models > MOST_MODELS:
            raise SdfError(
                file, f": holds more than {MOST_MODELS} models; split the world."
            )


class _Scope:
    """A world or a model: its frames by name, and its contents."""

    def __init__(
        self,
        element: Element,
        file: Path,
        name: str,
        order: _Order,
        include: Element | None = None,
    ) -> None:
        self.element = element
        self.file = file
        self.name = name
        self._order = order
        self.pose = element.find("pose")
        self.placement = element.get("placement_frame", "")
        if include is not None and include.find("pose") is not None:
            self.pose = include.find("pose")
            self.placement = _text(include, "placement_frame")
        self.models: list[_Scope] = []
        # why a model can't be read, by its name
        self.strange: list[tuple[str, ShapelessError]] = []
        states = element.iterfind("state/model")
        self._state = {state.get("name", ""): state.find("pose") for state in states}
        self._named: dict[str, Element | _Scope] = {}
        self._open: set[str] = set()  # frames whose poses are being resolved
        order.count(file)
        for child in element:
            self._add(child)

    @property
    def where(self) -> Where:
        if self.name:
            return Where(self.file, f": model {self.name!r}")
        return Where(self.file)

    def _add(self, child: Element) -> None:
        name = child.get("name", "") or _text(child, "name")
        if child.tag == "link" or (
            child.tag in ("frame", "joint") and name not in self._named
        ):
            self._named[name] = child
        elif child.tag == "model":
            self._add_model(child, self.file, name)
        elif child.tag in MOVING and self._order.takes(name):
            self.strange.append((name, ShapelessError(MOVING[child.tag])))
        elif child.tag == "include":
            uri = _text(child, "uri")
            name = name or uri.rstrip("/").rpartition("/")[2]
            file = _found(uri, self.file)
            if file is not None:
                model = self._order.root(file).find("model")
                if model is not None:  # else a light
                    called = _text(child, "name") or model.get("name", "")
                    self._add_model(model, file, called, child)
            elif name not in HARMLESS and self._order.takes(name):
                body = f"{uri!r}, which is neither beside the file nor on {PATHS[0]}"
                self.strange.append((name, ShapelessError(body, missing=True)))

    def _add_model(
        self,
        element: Element,
        file: Path,
        name: str,
        include: Element | None = None,
    ) -> None:
        whole = f"{self.name}::{name}" if self.name else name
        if self._order.takes(whole):
            model = _Scope(element, file, whole, self._order, include)
            self.models.append(model)
            self._named.setdefault(name, model)

    def frame(self, name: str) -> Array:
        """(4, 4) pose of a frame in this scope. Raises ConfigError for an unknown name."""
        if name in ("", "world", "__model__"):
            return np.eye(4)
        named = self._named.get(name)
        if named is None:
            first, _, rest = name.partition("::")
            inner = self._named.get(first)
            if rest and isinstance(inner, _Scope):
                return self.frame(first) @ inner.frame(rest)
            near = suggest(name, self._named) if self._named else "there are none here."
            raise self.where.error(f": there is no frame {name!r}; {near}")
        if name in self._open:
            raise self.where.error(
                f": the pose of {name!r} is relative to itself; give it another frame."
            )
        self._open.add(name)
        if isinstance(named, _Scope):
            pose = self.of_model(named)
        else:
            bases = {
                "joint": _text(named, "child"),
                "frame": named.get("attached_to", ""),
            }
            pose = self.posed(named.find("pose"), bases.get(named.tag, ""))
        self._open.remove(name)
        return pose

    def posed(
        self,
        pose: Element | None,
        base: str = "",
        start: Array | None = None,
        where: Where | None = None,
    ) -> Array:
        """(4, 4) of a `<pose>` in this scope; by default from `start`, or from the frame `base`."""
        if pose is None:
            frame = ""
        else:
            frame = pose.get("relative_to") or pose.get("frame") or ""
        if start is None or frame:
            start = self.frame(frame or base)
        return start @ _matrix(pose, where or self.where)

    def of_model(self, model: "_Scope") -> Array:
        """(4, 4) pose of a model in this scope."""
        state = self._state.get(model.name)
        if state is not None:
            return _matrix(state, model.where)
        placed = self.posed(model.pose, where=model.where)
        return placed @ np.linalg.inv(model.frame(model.placement))


class _Body(NamedTuple):
    """A collision geometry, or an error that explains why there is none."""

    model: str
    where: Where
    geometry: Element | ShapelessError
    pose: Array  # (4, 4) in the world

    def solid(self) -> Solid | None:
        """Return the body, or None for the ground. May raise ShapelessError."""
        if isinstance(self.geometry, ShapelessError):
            raise self.geometry
        shape = next(
            (child for child in self.geometry if ":" not in child.tag), Element("empty")
        )
        if shape.tag == "empty":
            return None
        if shape.tag == "plane":
            normal = self.pose[:3, :3] @ _floats(
                shape.findtext("normal", "0 0 1"), 3, self.where
            )
            if abs(normal[2]) < math.cos(TILT) * np.linalg.norm(normal):
                raise ShapelessError("a tilted plane")
            return None
        if shape.tag == "box":
            return Box(self._lengths(shape, "size", 3))
        if shape.tag == "sphere":
            return Sphere(*self._lengths(shape, "radius"))
        if shape.tag in ("cylinder", "capsule"):
            kind = Cylinder if shape.tag == "cylinder" else Capsule
            return kind(
                *self._lengths(shape, "radius"), *self._lengths(shape, "length")
            )
        if shape.tag == "polyline" and len(self.geometry.findall("polyline")) == 1:
            return self._prism(shape)
        what = "polyline with holes" if shape.tag == "polyline" else shape.tag
        article = "an" if what[0] in "aeiou" else "a"
        raise ShapelessError(f"{article} {what} {_text(shape, 'uri')}".rstrip())

    def _prism(self, polyline: Element) -> Solid:
        texts = [point.text or "" for point in polyline.findall("point")]
        points = [_floats(text, 2, self.where.at(": <point>")) for text in texts]
        if len(points) > 1 and points[0] == points[-1]:
            points.pop()
        if len(set(points)) < 3:
            raise self.where.error(
                ": <polyline> needs at least three different points; add some."
            )
        if len(points) > MOST_CORNERS:
            raise self.where.error(
                f": <polyline> has {len(points)} points; the maximum is "
                f"{MOST_CORNERS}; simplify it."
            )
        return Prism(tuple(points), *self._lengths(polyline, "height"))

    def _lengths(self, shape: Element, key: str, count: int = 1) -> tuple[float, ...]:
        where = self.where.at(f": <{key}> of its <{shape.tag}>")
        text = shape.findtext(key)
        if text is None:
            raise where.error(" is missing; add it.")
        lengths = _floats(text, count, where)
        if not all(SMALLEST <= length <= LARGEST for length in lengths):
            raise where.error(
                f" must be above 0 and at most {LARGEST:g} m, not {text!r}."
            )
        return lengths


def read_sdf(
    path: str | Path,
    height: float,
    without: tuple[str, ...] = (),
    skip_unknown: bool = False,
) -> Standing:
    """Read the obstacles of a Gazebo world at a height [m] above z = 0.

    Args:
        path: path of a `.world` or `.sdf` file.
        height: height at which bodies are cut: the lidar's [m].
        without: names of models to leave out; `*` matches anything.
        skip_unknown: True to leave out bodies that have no supported shape: meshes and
            tilted bodies.

    Raises:
        ConfigError: the file is damaged or not SDF, has an unsupported shape, or has no
            obstacles at that height.
    """
    check_path("path", path)
    path = Path(path)
    placed = list[Placed]()
    unknown = dict[str, list[str]]()
    missing = set[str]()  # those of these models whose file is missing
    seen = 0
    try:
        for body in _bodies(_Scope(_world(path), path, "", _Order(without)), np.eye(4)):
            seen += 1
            try:
                obstacle = _section_of(body, height)
            except ShapelessError as error:
                unknown.setdefault(body.model, []).append(str(error))
                if error.missing:
                    missing.add(body.model)
                continue
            if obstacle is not None:
                placed.append(obstacle)
            if len(placed) > MOST_OBSTACLES:
                reason = f"holds more than {MOST_OBSTACLES} bodies at a height of {height:g} m"
                raise SdfError(
                    path,
                    f": {reason}; leave some out by --without MODEL, or split the world.",
                )
    except RecursionError:
        raise SdfError(path, ": is nested too deeply; flatten its models.") from None
    left_out = tuple(
        f"model {name!r} has {', '.join(what)}" for name, what in unknown.items()
    )
    shapes = seen - sum(map(len, unknown.values()))
    if left_out and not (skip_unknown and shapes):
        raise AssetsError(
            path,
            f": {_explain_left_out(left_out, skip_unknown)}",
            next(iter(unknown)) in missing,
        )
    if not placed:
        reason = f"none of its {shapes} collision geometries is at height {height:g} m"
        raise SdfError(path, f": {reason}; choose another --height.")
    return Standing(tuple(placed), left_out)


def _explain_left_out(left_out: tuple[str, ...], skip_unknown: bool) -> str:
    """Return what is wrong with the first of some models, and the fix."""
    fix = "put a box in its place"
    if not skip_unknown:
        fix = f"leave it out by --skip-unknown or --without MODEL, or {fix}"
    more = f" (as do {len(left_out) - 1} more models)" if len(left_out) > 1 else ""
    return f"{left_out[0]}{more}, which a world can't contain; {fix}."


def _section_of(body: "_Body", height: float) -> Placed | None:
    """Return a body's shape at a height [m]; None for the ground, or above or below.

    Raises ShapelessError, or ConfigError for a shape that worlds reject.
    """
    solid = body.solid()
    if solid is None:
        return None
    try:
        return section(solid, body.pose, height)
    except ValidationError as error:
        problem = error.errors(include_url=False)[0]["msg"].removeprefix(
            "Value error, "
        )
        raise body.where.error(
            f": its shape at a height of {height:g} m can't stand in a "
            f"world ({problem}); change it."
        ) from None


def _bodies(scope: _Scope, pose: Array) -> Iterator[_Body]:
    """Yield all collision geometries of a scope with a pose (4, 4) in the world."""
    for name, error in scope.strange:
        yield _Body(name, scope.where, error, pose)
    for link in scope.element.iterfind("link"):
        of_link = scope.posed(link.find("pose"))
        for collision in link.iterfind("collision"):
            where = scope.where.at(f", collision {collision.get('name', '')!r}")
            of_collision = scope.posed(collision.find("pose"), start=of_link)
            geometry = collision.find("geometry")
            if geometry is not None:
                yield _Body(scope.name, where, geometry, pose @ of_collision)
    for model in scope.models:
        yield from _bodies(model, pose @ scope.of_model(model))


def _matrix(pose: Element | None, where: Where) -> Array:
    """(4, 4) of the numbers in a `<pose>`, with angles about the fixed axes x, y, z."""
    matrix = np.eye(4)
    if pose is None or not (pose.text or "").strip():
        return matrix
    unknown = [name for name in pose.attrib if name not in POSE and ":" not in name]
    if unknown:
        hint = suggest(unknown[0], POSE)
        raise where.error(f": unknown attribute {unknown[0]!r} of a <pose>; {hint}")
    form = pose.get("rotation_format", "euler_rpy")
    degrees = pose.get("degrees", "false")
    for name, value, allowed in (
        ("rotation_format", form, list(NUMBERS)),
        ("degrees", degrees, ["true", "false", "1", "0"]),
    ):
        if value not in allowed:
            hint = suggest(value, allowed)
            raise where.error(f": attribute {name}={value!r} of a <pose>; {hint}")
    numbers = _floats(pose.text or "", NUMBERS[form], where.at(": <pose>"))
    matrix[:3, 3] = numbers[:3]
    rotation = scipy.spatial.transform.Rotation
    if form == "quat_xyzw":
        if not any(numbers[3:]):
            raise where.error(": the quaternion of a <pose> is 0; give a rotation.")
        turned = rotation.from_quat(numbers[3:])
        matrix[:3, :3] = turned.as_matrix()
    elif any(numbers[3:]):
        in_degrees = degrees in ("true", "1")
        turned = rotation.from_euler("xyz", numbers[3:], in_degrees)
        matrix[:3, :3] = turned.as_matrix()
    return matrix


def _floats(text: str, count: int, where: Where) -> tuple[float, ...]:
    try:
        numbers = tuple(float(word) for word in text.split())
    except ValueError:
        numbers = ()
    if len(numbers) != count or not all(abs(number) <= FARTHEST for number in numbers):
        words = f"{count} numbers" if count > 1 else "a number"
        raise where.error(f" must be {words}, not {text.strip()!r}.")
    return numbers


def _text(element: Element, tag: str) -> str:
    return element.findtext(tag, "").strip()


def _found(uri: str, file: Path) -> Path | None:
    """Find the file of an included model, beside a file or on Gazebo's paths."""
    kind, _, name = uri.rpartition("://")
    if kind.startswith("http"):
        return None
    folder = file.resolve().parent
    folders = [folder, folder / "models", folder.parent, folder.parent / "models"]
    for key in PATHS:
        listed = os.environ.get(key, "").split(os.pathsep)
        folders += [Path(entry) for entry in listed if entry]
    for parent in folders:
        path = parent / name
        if name and path.is_file():
            return path
        if name and path.is_dir():
            found = _find_newest(path)
            return found if found.is_file() else None
    return None


def _find_newest(folder: Path) -> Path:
    """Return the SDF of the newest version in the folder of a model."""
    config = folder / "model.config"
    versions = list(_tree(config).iterfind("sdf")) if config.is_file() else []
    newest = max(
        versions, key=lambda sdf: _version(sdf.get("version", "")), default=None
    )
    return folder / ("model.sdf" if newest is None else (newest.text or "").strip())


def _version(text: str) -> tuple[int, ...]:
    return tuple(int(part) for part in text.split(".") if part.isdecimal())


def _world(path: Path) -> Element:
    """The world of a file, or its root if that contains only models."""
    root = root_of(path)
    worlds = root.findall("world")
    if len(worlds) > 1 or not (worlds or root.findall("model")):
        raise SdfError(path, f": holds {len(worlds)} worlds; give a file with one.")
    return worlds[0] if worlds else root


def root_of(path: Path) -> Element:
    """Return the root of an SDF file, with its tags unchanged. Raises ConfigError."""
    root = _tree(path)
    if root.tag != "sdf":
        raise SdfError(
            path, f": is not SDF but <{root.tag}>; give a .world or .sdf file."
        )
    version = root.get("version", "")
    if not OLDEST <= _version(version) <= NEWEST:
        span = " to ".join(".".join(map(str, end)) for end in (OLDEST, NEWEST))
        raise SdfError(
            path,
            f": SDF version {version!r} is not supported, only {span}; convert it by `gz sdf -p`.",
        )
    return root


def _tree(path: Path) -> Element:
    """Read XML. Raises ConfigError with line and column, and for entity declarations."""
    try:
        if check_no_device(path).stat().st_size > MOST_BYTES:
            raise SdfError(
                path, f": is larger than {MOST_BYTES // 2**20} MB; give a smaller file."
            )
        data = path.read_bytes()
    except OSError as error:
        raise SdfError(path, f": can't be read ({error.strerror}).") from None
    parser, builder = expat.ParserCreate(), TreeBuilder()

    def refuse(*_: Any) -> None:
        reason = "declares a document type, whose entities can expand without end"
        line = parser.CurrentLineNumber
        raise SdfError(path, f", line {line}: {reason}; remove <!DOCTYPE>.")

    parser.StartDoctypeDeclHandler = refuse
    parser.StartElementHandler = builder.start
    parser.EndElementHandler = builder.end
    parser.CharacterDataHandler = builder.data
    try:
        parser.Parse(data, True)
    except (expat.ExpatError, ValueError, LookupError) as error:
        at = f"line {parser.ErrorLineNumber}, column {parser.ErrorColumnNumber + 1}"
        problem = expat.ErrorString(parser.ErrorCode) or str(error)
        raise SdfError(
            path, f", {at}: is not valid XML: {problem}; correct it."
        ) from None
    return builder.close()


def section(solid: Solid, pose: Array, height: float) -> Placed | None:
    """Cut a body at a height above the ground.

    Args:
        solid: the body.
        pose: (4, 4) of the body in the world [m].
        height: of the plane [m].

    Returns:
        The shape, and its pose x, y [m], heading [rad]; None if the plane misses the
        body.

    Raises:
        ShapelessError: the body is tilted, and its section is neither circle, rectangle
            nor polygon.
    """
    cut = solid.cut(pose, height - float(pose[2, 3]))
    if cut is None or not cut[0].radius > SMALLEST:
        return None
    shape, *place = cut
    x, y, heading = (round(value, DIGITS) + 0.0 for value in place)
    return shape, (x, y, heading)


def _find_vertical_axis(pose: Array) -> int | None:
    """Return which of the body's axes, 0 to 2, is vertical; None if none is."""
    upright = np.abs(pose[2, :3]) > math.cos(TILT)
    return int(np.argmax(upright)) if upright.any() else None


def _find_heading(pose: Array, axis: int) -> float:
    return math.atan2(pose[1, axis], pose[0, axis])


def _make_disc(pose: Array, radius2: float) -> _Cut:
    """Return a circle around the origin; None if the squared radius is not positive."""
    radius = round(math.sqrt(max(radius2, 0.0)), DIGITS)
    return (Circle(radius=radius), pose[0, 3], pose[1, 3], 0.0) if radius else None


def _make_rectangle(pose: Array, along: int, length: float, width: float) -> _Cut:
    x, y = (max(round(side, DIGITS), SMALLEST) for side in (length, width))
    return Rectangle(size=(x, y)), pose[0, 3], pose[1, 3], _find_heading(pose, along)


def _make_polygon(points: Array) -> Polygon:
    return Polygon(points=np.round(points, DIGITS).tolist())
