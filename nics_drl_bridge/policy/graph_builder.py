"""Builds the ONNX graph of a policy file, node by node, around a network.

A foreign network may use any opset from 8 on. The nodes added here therefore use only operators
that mean the same in all of them. `Clip` (limits are inputs only since opset 11), `Where` (since
opset 9) and atan2 (no such operator) are composed from arithmetic.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
import onnx
from numpy.typing import ArrayLike

from nics_drl_bridge.geometry import Array
from nics_drl_bridge.policy.foreign_mapping import Limits, Scaled

# slope of the steep ramp that replaces a step: only numbers from -1e-30 to 0 are on the ramp
STEEP = 1e30


class Builder:
    """A growing graph: lists of its nodes and weights.

    Each method adds nodes and returns the name of the resulting tensor, to be passed to other
    methods. All tensors are rows (1, K), because the graph takes one observation at a time.
    """

    def __init__(self, prefix: str = "") -> None:
        self._prefix = prefix  # of the names of all tensors added here
        self.nodes: list[Any] = []  # onnx.NodeProto, in the order of computation
        self.weights: list[Any] = []  # onnx.TensorProto

    def constant(self, values: ArrayLike, kind: Any = np.float32) -> str:
        """Adds an array as a weight; `kind` is its dtype."""
        name = f"{self._prefix}constant_{len(self.weights)}"
        tensor = onnx.numpy_helper.from_array(np.asarray(values, kind), name)
        self.weights.append(tensor)
        return name

    def add(self, kind: str, *inputs: str, name: str = "", **settings: Any) -> str:
        """Adds a node of an ONNX operator with one output, called `name` if one is given."""
        name = name or f"{self._prefix}{kind.lower()}_{len(self.nodes)}"
        self.nodes.append(onnx.helper.make_node(kind, inputs, [name], **settings))
        return name

    def pick(self, row: str, places: Sequence[int]) -> str:
        """Selects the elements of a row at these places."""
        return self.add("Gather", row, self.constant(places, np.int64), axis=1)

    def join(self, rows: Sequence[str], name: str = "") -> str:
        """Concatenates rows."""
        return self.add("Concat", *rows, name=name, axis=1)

    def clamp(self, row: str, limits: Limits | tuple[Array, Array] | None) -> str:
        """Clamps the elements of a row between two limits; None leaves them as they are."""
        if limits is None:
            return row
        low, high = map(self.constant, limits)
        raised = self.add("Max", row, low)
        return self.add("Min", raised, high)

    def affine(self, row: str, factor: ArrayLike, offset: ArrayLike) -> str:
        """Computes row * factor + offset, without nodes that would change nothing."""
        if np.any(np.asarray(factor) != 1.0):
            row = self.add("Mul", row, self.constant(factor))
        if np.any(offset):
            row = self.add("Add", row, self.constant(offset))
        return row

    def scale(self, row: str, scaled: Scaled) -> str:
        """Scales a row as a mapping describes it: clamp, subtract, divide, clamp."""
        row = self.clamp(row, scaled.limits)
        if np.any(scaled.subtract):
            row = self.add("Sub", row, self.constant(scaled.subtract))
        if scaled.divide != 1.0:
            row = self.add("Div", row, self.constant(scaled.divide))
        return self.clamp(row, scaled.clip)

    def select(self, condition: str, row: str, fallback: str) -> str:
        """Selects `row` where `condition` (1, 1) is 1 and `fallback` where it is 0.

        Computes condition * row + (1 - condition) * fallback, so both must be finite.
        """
        opposite = self.affine(condition, -1.0, 1.0)
        from_row = self.add("Mul", condition, row)
        from_fallback = self.add("Mul", opposite, fallback)
        return self.add("Add", from_row, from_fallback)

    def is_negative(self, row: str) -> str:
        """Computes 1 where a row is negative and 0 elsewhere, as a very steep ramp."""
        ramp = self.affine(row, -STEEP, 0.0)
        return self.clamp(ramp, (0.0, 1.0))

    def angle(self, cosine: str, sine: str) -> str:
        """Computes the angle atan2(sine, cosine) [rad], with cosine^2 + sine^2 = 1.

        In the first quadrant it is 2 atan(sine / (1 + cosine)), which never divides by 0. A
        negative cosine mirrors it at pi / 2, a negative sine changes its sign.
        """
        sine_size = self.add("Abs", sine)
        cosine_size = self.add("Abs", cosine)
        divisor = self.affine(cosine_size, 1.0, 1.0)
        tangent_of_half = self.add("Div", sine_size, divisor)
        half = self.add("Atan", tangent_of_half)
        ahead = self.affine(half, 2.0, 0.0)
        behind = self.affine(half, -2.0, np.pi)
        size = self.select(self.is_negative(cosine), behind, ahead)
        sign = self.affine(self.is_negative(sine), -2.0, 1.0)
        return self.add("Mul", size, sign)
