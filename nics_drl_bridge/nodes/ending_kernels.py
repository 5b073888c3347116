"""The end of a process by a signal that Python can't see, because it is compiling."""

from functools import cache
from typing import Any

from llvmlite import binding as llvm

CODE = """
declare void @_exit(i32)
define void @leave(i32 %number) {
  call void @_exit(i32 0)
  ret void
}
"""


@cache
def _engine() -> Any:  # the code lives as long as it
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    target = llvm.Target.from_default_triple().create_target_machine()
    return llvm.create_mcjit_compiler(llvm.parse_assembly(CODE), target)


def address_of_leave() -> int:
    """Returns the address of a C function `void leave(int)`: a handler that ends with code 0."""
    return int(_engine().get_function_address("leave"))
