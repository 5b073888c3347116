"""The innermost step of the baked lidar, in vector instructions of LLVM: a block of beams.

Written out, because LLVM surrounds a plain loop with checks and remainder loops that take as long
as the loop itself: a span is two or three blocks long. All indices must be within the arrays.
"""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import types
from numba.extending import intrinsic

BLOCK = 16
"""Number of beams fused at once."""
WHOLE = ir.IntType(32)
SINGLES = ir.VectorType(ir.FloatType(), BLOCK)
WHOLES = ir.VectorType(WHOLE, BLOCK)
INF = float("inf")


def _address(context: Any, builder: Any, array: Any, value: Any, index: Any) -> Any:
    """Address of an element of an array, by its index from the begin of the array."""
    return builder.gep(context.make_array(array)(context, builder, value).data, [index])


def _all(builder: Any, number: Any, kind: Any) -> Any:
    """Broadcasts one number to a vector."""
    nothing = ir.Constant(kind, ir.Undefined)
    one = builder.insert_element(nothing, number, WHOLE(0))
    return builder.shuffle_vector(one, nothing, ir.Constant(WHOLES, [0] * BLOCK))


def _blend(builder: Any, one: Any, other: Any, weight: Any) -> Any:
    step = builder.fmul(weight, builder.fsub(other, one), flags=("contract",))
    return builder.fadd(one, step, flags=("contract",))


def _limited(builder: Any, value: Any, low: Any, high: Any) -> Any:
    """Applies the range limits: too far becomes `inf`, too close `-inf`."""
    nothing, close = (ir.Constant(SINGLES, [end] * BLOCK) for end in (INF, -INF))
    value = builder.select(builder.fcmp_ordered("<=", value, high), value, nothing)
    return builder.select(builder.fcmp_ordered(">=", value, low), value, close)


@intrinsic
def lower_block(typing, ranges, at, rows, points, skip, weights, limits, within):  # type: ignore[no-untyped-def]
    """Lowers the beams from `at + skip` to the blend of the points from `skip` on.

    Args:
        ranges: float32 array.
        at: index of the first beam of the first block.
        rows: (R,) float32.
        points: indices of the first point in the near row, of the next one, and of both in the far
            row, for the first block.
        skip: beams before this block.
        weights: float32 of the next points, and of the far row.
        limits: float32 range_min, range_max.
        within: int32 place of the first beam that is hit, and number of beams hit.
    """

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        kinds = signature.args

        def unpacked(k: int, vector: Any) -> list[Any]:
            numbers = (builder.extract_value(args[k], i) for i in range(len(kinds[k])))
            return [_all(builder, number, vector) for number in numbers]

        def block(k: int, index: Any) -> Any:
            index = builder.add(index, args[4])
            address = _address(context, builder, kinds[k], args[k], index)
            return builder.bitcast(address, SINGLES.as_pointer())

        indices = [builder.extract_value(args[3], i) for i in range(4)]
        near, near2, far, far2 = (builder.load(block(2, i), align=4) for i in indices)
        (part, share), (low, high) = unpacked(5, SINGLES), unpacked(6, SINGLES)
        first, hits = unpacked(7, WHOLES)
        near, far = _blend(builder, near, near2, part), _blend(builder, far, far2, part)
        value = _limited(builder, _blend(builder, near, far, share), low, high)
        place = _all(builder, builder.trunc(args[4], WHOLE), WHOLES)
        place = builder.add(place, ir.Constant(WHOLES, list(range(BLOCK))))
        hit = builder.icmp_unsigned("<", builder.sub(place, first), hits)
        value = builder.select(hit, value, ir.Constant(SINGLES, [INF] * BLOCK))
        address = block(0, args[1])
        held = builder.load(address, align=4)
        lower = builder.select(builder.fcmp_ordered("<", value, held), value, held)
        builder.store(lower, address, align=4)
        return context.get_dummy_value()

    pair, index = types.UniTuple(types.float32, 2), types.int64
    four, two = types.UniTuple(index, 4), types.UniTuple(types.int32, 2)
    return types.void(ranges, index, rows, four, index, pair, pair, two), generate


@intrinsic
def lower_beam(typing, ranges, at, value):  # type: ignore[no-untyped-def]
    """Lowers one beam, see `lower_block`."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        address = _address(context, builder, signature.args[0], args[0], args[1])
        held = builder.load(address)
        less = builder.fcmp_ordered("<", args[2], held)
        builder.store(builder.select(less, args[2], held), address)
        return context.get_dummy_value()

    return types.void(ranges, types.int64, types.float32), generate


@intrinsic
def prefetch(typing, array, index):  # type: ignore[no-untyped-def]
    """Prefetches array[index] into the cache; the index may be out of bounds."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        address = _address(context, builder, signature.args[0], args[0], args[1])
        address = builder.bitcast(address, ir.IntType(8).as_pointer())
        kind = ir.FunctionType(ir.VoidType(), [address.type, WHOLE, WHOLE, WHOLE])
        ask = builder.module.declare_intrinsic("llvm.prefetch", [address.type], kind)
        builder.call(ask, [address, WHOLE(0), WHOLE(3), WHOLE(1)])
        return context.get_dummy_value()

    return types.void(array, types.int64), generate
