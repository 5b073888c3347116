"""The innermost step of the baked lidar in vector instructions: one block of beams is fused."""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import types
from numba.extending import intrinsic

BLOCK = 16
"""So many beams are fused at once."""
FLOATS = ir.VectorType(ir.FloatType(), BLOCK)
WHOLES = ir.VectorType(ir.IntType(32), BLOCK)
INF = float("inf")


def _all(builder: Any, value: Any, kind: Any) -> Any:
    """A vector of the same number."""
    one = builder.insert_element(ir.Constant(kind, ir.Undefined), value, ir.Constant(ir.IntType(32), 0))
    zeros = ir.Constant(WHOLES, [0] * BLOCK)
    return builder.shuffle_vector(one, ir.Constant(kind, ir.Undefined), zeros)


@intrinsic
def lower_block(typing, ranges, at, rows, points, weights, limits, within):  # type: ignore[no-untyped-def]
    """Lowers the block of beams ranges[at:at + BLOCK] to the blend of four parts of `rows`.

    Args:
        ranges: float32, C-contiguous.
        at: index of the first beam in all of `ranges`.
        rows: (R,) float32.
        points: four indices: near, its next point, far, its next point.
        weights: of the next points, and of far.
        limits: float32 range_min and range_max.
        within: int32 first beam of the block that is hit, and how many are.
    """

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        out = context.make_array(signature.args[0])(context, builder, args[0]).data
        data = context.make_array(signature.args[2])(context, builder, args[2]).data
        near, near2, far, far2 = (
            builder.load(
                builder.bitcast(builder.gep(data, [point]), FLOATS.as_pointer()), align=4
            )
            for point in (builder.extract_value(args[3], k) for k in range(4))
        )
        part, share = (_all(builder, builder.extract_value(args[4], k), FLOATS) for k in range(2))
        low, high = (_all(builder, builder.extract_value(args[5], k), FLOATS) for k in range(2))
        first, hits = (_all(builder, builder.extract_value(args[6], k), WHOLES) for k in range(2))

        def blend(one: Any, other: Any, weight: Any) -> Any:
            step = builder.fmul(weight, builder.fsub(other, one), flags=("contract",))
            return builder.fadd(one, step, flags=("contract",))

        value = blend(blend(near, near2, part), blend(far, far2, part), share)
        nothing, close = (ir.Constant(FLOATS, [sign * INF] * BLOCK) for sign in (1.0, -1.0))
        value = builder.select(builder.fcmp_ordered("<=", value, high), value, nothing)
        value = builder.select(builder.fcmp_ordered(">=", value, low), value, close)
        place = builder.sub(ir.Constant(WHOLES, list(range(BLOCK))), first)
        value = builder.select(builder.icmp_unsigned("<", place, hits), value, nothing)
        pointer = builder.bitcast(builder.gep(out, [args[1]]), FLOATS.as_pointer())
        held = builder.load(pointer, align=4)
        lower = builder.select(builder.fcmp_ordered("<", value, held), value, held)
        builder.store(lower, pointer, align=4)
        return context.get_dummy_value()

    return types.void(ranges, types.int64, rows, types.UniTuple(types.int64, 4), types.UniTuple(types.float32, 2), types.UniTuple(types.float32, 2), types.UniTuple(types.int32, 2)), generate


@intrinsic
def prefetch(typing, array, index):  # type: ignore[no-untyped-def]
    """Asks for array[index] to be in the cache soon."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        pointer = builder.gep(context.make_array(signature.args[0])(context, builder, args[0]).data, [args[1]])
        i32 = ir.IntType(32)
        pointer = builder.bitcast(pointer, ir.IntType(8).as_pointer())
        kind = ir.FunctionType(ir.VoidType(), [pointer.type, i32, i32, i32])
        function = builder.module.declare_intrinsic("llvm.prefetch", [pointer.type], kind)
        builder.call(function, [pointer, i32(0), i32(3), i32(1)])
        return context.get_dummy_value()

    return types.void(array, types.int64), generate


@intrinsic
def lower_beam(typing, ranges, at, value):  # type: ignore[no-untyped-def]
    """Lowers one beam of all of `ranges`."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        out = context.make_array(signature.args[0])(context, builder, args[0]).data
        pointer = builder.gep(out, [args[1]])
        held = builder.load(pointer)
        builder.store(builder.select(builder.fcmp_ordered("<", args[2], held), args[2], held), pointer)
        return context.get_dummy_value()

    return types.void(ranges, types.int64, types.float32), generate
