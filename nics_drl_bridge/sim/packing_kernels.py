"""Many arrays as one argument of a kernel: passing a hundred takes longer than a step."""

from typing import Any

from numba import types
from numba.experimental import structref

from nics_drl_bridge.kernels import kernel


@structref.register
class PackedType(types.StructRef):  # type: ignore[misc]
    """The type of `Packed`."""


class Packed(structref.StructRefProxy):  # type: ignore[misc]
    """A NamedTuple of arrays, as the kernels' argument `packed`; `packed.content` is the tuple."""


structref.define_proxy(Packed, PackedType, ["content"])


@kernel(allocates=True)
def pack(content: Any) -> Any:
    """Make one argument of a NamedTuple."""
    return Packed(content)
