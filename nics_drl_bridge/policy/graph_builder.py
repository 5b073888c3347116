"""Builds the ONNX graph of a policy file, node by node, around a network."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import onnx
from numpy.typing import ArrayLike

from nics_drl_bridge.geometry import Array
from nics_drl_bridge.policy.foreign_mapping import Limits, Scaled

STEP = 1e30  # factor that lifts nearly every non-zero float32 above 1


class Builder:
    """Nodes and weights of a growing graph; each name stands for a tensor of one row (1, K)."""

    def __init__(self, prefix: str = "") -> None:
        self._prefix = prefix
        self.nodes: list[Any] = []
        self.weights: list[Any] = []

    def constant(self, values: ArrayLike, kind: Any = np.float32) -> str:
        """Adds an array of weights."""
        name = f"{self._prefix}constant_{len(self.weights)}"
        self.weights.append(
            onnx.numpy_helper.from_array(np.asarray(values, kind), name)
        )
        return name

    def add(self, kind: str, *inputs: str, name: str = "", **settings: Any) -> str:
        """Adds a node with one output."""
        name = name or f"{self._prefix}{kind.lower()}_{len(self.nodes)}"
        self.nodes.append(onnx.helper.make_node(kind, inputs, [name], **settings))
        return name

    def pick(self, row: str, places: Sequence[int]) -> str:
        """Selects elements of a row."""
        return self.add("Gather", row, self.constant(places, np.int64), axis=1)

    def join(self, rows: Sequence[str], name: str = "") -> str:
        """Concatenates rows."""
        return self.add("Concat", *rows, name=name, axis=1)

    def cut(self, row: str, limits: Limits | tuple[Array, Array] | None) -> str:
        """Clamps the elements of a row between two limits."""
        if limits is None:
            return row
        low, high = map(self.constant, limits)
        return self.add("Min", self.add("Max", row, low), high)

    def affine(self, row: str, factor: ArrayLike, offset: ArrayLike) -> str:
        """Computes row * factor + offset."""
        if np.any(np.asarray(factor) != 1.0):
            row = self.add("Mul", row, self.constant(factor))
        return self.add("Add", row, self.constant(offset)) if np.any(offset) else row

    def scale(self, row: str, scaled: Scaled) -> str:
        """Scales a row as described by `Scaled`."""
        row = self.cut(row, scaled.limits)
        if np.any(scaled.subtract):
            row = self.add("Sub", row, self.constant(scaled.subtract))
        if scaled.divide != 1.0:
            row = self.add("Div", row, self.constant(scaled.divide))
        return self.cut(row, scaled.clip)

    def blend(self, share: str, row: str, start: str) -> str:
        """Selects `row` if `share` (1, 1) is 1, `start` if it is 0."""
        rest = self.affine(share, -1.0, 1.0)
        kept = self.add("Mul", share, row)
        begun = self.add("Mul", rest, start)
        return self.add("Add", kept, begun)

    def is_negative(self, row: str) -> str:
        """Computes 1 where a row is negative, else 0."""
        return self.cut(self.affine(row, -STEP, 0.0), (0.0, 1.0))

    def angle(self, cosine: str, sine: str) -> str:
        """Computes the angle [rad] of a direction, exact up to rounding in all four quadrants."""
        across = self.add("Abs", sine)
        along = self.add("Abs", cosine)
        half = self.add("Atan", self.add("Div", across, self.affine(along, 1.0, 1.0)))
        ahead = self.affine(half, 2.0, 0.0)
        behind = self.affine(half, -2.0, np.pi)
        size = self.blend(self.is_negative(cosine), behind, ahead)
        return self.add("Mul", size, self.affine(self.is_negative(sine), -2.0, 1.0))
