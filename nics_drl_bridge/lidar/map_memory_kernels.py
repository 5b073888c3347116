"""Reads and writes that tell LLVM what plain indexing does not: lanes never overlap the map.

The map is what nobody writes meanwhile: a grid map, or a lidar table. Without it, LLVM must assume
that writing to a lane may change the map that another lane is about to read, and does not turn the
loops of `map_kernels` and `baked_kernels` over lanes into vector instructions. The instructions
carry scoped alias metadata: the map's reads belong to one scope, and the accesses to
lanes declare that they are not in it. All indices must be within the array and not negative.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba import types
from numba.extending import intrinsic


def _scope(builder: Any) -> Any:
    """The alias scope of the map, as metadata of the module being compiled."""
    module = builder.module
    domain = module.add_metadata([ir.MetaDataString(module, "nics.map.domain")])
    scope = module.add_metadata([ir.MetaDataString(module, "nics.map"), domain])
    return module.add_metadata([scope])


def _address(context: Any, builder: Any, signature: Any, args: Any) -> Any:
    array = context.make_array(signature.args[0])(context, builder, args[0])
    return builder.gep(array.data, [args[1]])


def _load(belonging: str) -> Callable[..., Any]:
    """What generates a read; `belonging` is how it belongs to the scope of the map."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        value = builder.load(_address(context, builder, signature, args))
        value.set_metadata(belonging, _scope(builder))
        return value

    return generate


@intrinsic
def peek(typing, array, index):  # type: ignore[no-untyped-def]
    """array[index] of the map (C-contiguous, 1-d), which nothing writes meanwhile."""
    return array.dtype(array, types.int64), _load("alias.scope")


@intrinsic
def get(typing, array, index):  # type: ignore[no-untyped-def]
    """array[index] of lanes (C-contiguous, 1-d), which are not the map."""
    return array.dtype(array, types.int64), _load("noalias")


@intrinsic
def put(typing, array, index, value):  # type: ignore[no-untyped-def]
    """array[index] = value in lanes (C-contiguous, 1-d), which are not the map."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        store = builder.store(args[2], _address(context, builder, signature, args))
        store.set_metadata("noalias", _scope(builder))
        return context.get_dummy_value()

    return types.void(array, types.int64, array.dtype), generate
