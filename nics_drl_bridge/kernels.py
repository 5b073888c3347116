"""`@kernel`: the one decorator by which functions are compiled, kept on disk, and kept up to date.

numba checks the file of the function itself only. Here, machine code on disk is kept as long as no
module that its own module imports, directly or not, has changed its content: of this package, or of
the folders in which a kernel of your own lies.
"""

import gc
import hashlib
import math
import os
import re
import threading
import time
from collections.abc import Callable
from functools import cache, partial
from pathlib import Path
from typing import Any

from llvmlite import binding as llvm
from llvmlite import ir
from numba import types
from numba.core import event
from numba.core.caching import CompileResultCacheImpl, FunctionCache, IndexDataCacheFile
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import Compiler, Flags, compile_result
from numba.core.compiler_lock import global_compiler_lock
from numba.core.registry import CPUDispatcher
from numba.core.sigutils import normalize_signature
from numba.extending import intrinsic
from numba.np.arrayobj import make_array

from nics_drl_bridge.status import REPEATED_S, STATUS

PACKAGE = Path(__file__).parent
PATIENCE_S = 2.0  # Compiling that takes longer is announced, on standard error
SECONDS_EACH = 0.5  # typical for a kernel with what only it calls [s]
TRUSTED_AFTER = 5  # kernels after which the pace of this process counts as much as that
KERNELS: list[Any] = []  # every kernel that was imported so far, as numba's dispatchers
_IMPORT = re.compile(
    r"^[ \t]*(?:from[ \t]+([.\w]+)[ \t]+import[ \t]+(\([^)]*\)|[^\n]*)|import[ \t]+([^\n]*))",
    re.MULTILINE,
)
_DEFAULTS = {name: option.default for name, option in Flags.options.items()}
# numba compares them half a million times, a twentieth of the time of compiling: the same in C.
Flags.values = lambda flags: _DEFAULTS | flags._values
_ALIAS = re.compile(r"\bas\s+\w+")


def kernel(
    function: Callable[..., Any] | None = None,
    *,
    allocates: bool = False,
    contracts: bool = False,
    inline: bool = False,
    view: bool = False,
) -> Callable[..., Any]:
    """Compiles a function with numba when it is first called, or loads what was compiled before.

    It runs without the interpreter's lock; a division by zero gives inf or NaN. It `allocates` if
    it makes arrays or other objects, or calls what does; `contracts` lets products and sums be
    fused, with one rounding; `inline` compiles it into all callers, where that was measured to pay.
    A `view` returns parts of its arguments' arrays, for which it is written into its callers.
    """
    if function is None:
        return partial(
            kernel, allocates=allocates, contracts=contracts, inline=inline, view=view
        )
    options: dict[str, Any] = {"nopython": True, "nogil": True, "error_model": "numpy"}
    options |= {"boundscheck": None, "no_cfunc_wrapper": True}
    options |= {} if allocates else {"_nrt": False}
    options |= {"fastmath": {"contract"}} if contracts else {}
    options |= {"forceinline": True} if inline else {}
    options |= {"inline": "always"} if view else {}
    compiled: Callable[..., Any] = _Kernel(function, targetoptions=options)
    KERNELS.append(compiled)
    return compiled


@intrinsic
def prefetch(_typing: Any, array: Any, index: Any) -> Any:
    """Asks for array[index] (n,) to be in the cache soon, before a kernel waits for it."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        data = make_array(signature.args[0])(context, builder, args[0]).data
        whole = ir.IntType(32)
        byte = ir.IntType(8).as_pointer()
        place = builder.bitcast(builder.gep(data, [args[1]]), byte)
        kind = ir.FunctionType(ir.VoidType(), [byte, whole, whole, whole])
        ask = builder.module.declare_intrinsic("llvm.prefetch", [byte], kind)
        builder.call(
            ask, [place, whole(0), whole(3), whole(1)]
        )  # to read; to keep; of the data
        return context.get_dummy_value()

    return types.void(array, types.intp), generate


class _InnerLibrary(JITCodeLibrary):  # type: ignore[misc]
    """Code that only kernels call: it is optimised, and made machine code, as a part of theirs."""

    @property
    def codegen(self) -> Any:
        """Keeps no environments, as nothing runs."""
        return self

    def set_env(self, name: str, env: Any) -> None:
        """Does nothing, see `_Kernel.add_overload`."""

    def get_pointer_to_function(self, name: str) -> int:
        self._ensure_finalized()
        return 0

    def serialize_using_object_code(self) -> Any:
        return self.serialize_using_bitcode()

    def _optimize_final_module(self) -> None:
        pass

    def _finalize_final_module(self) -> None:
        self._finalize_dynamic_globals()
        self._finalized = True


class _InnerCacheImpl(CompileResultCacheImpl):  # type: ignore[misc]
    def rebuild(self, target_context: Any, payload: Any) -> Any:
        (name, _, bitcode), fndesc, env, signature, *_, reload_init, envs = payload
        for function in reload_init or ():
            function()
        library = _InnerLibrary(target_context.codegen(), name)
        library._final_module = llvm.parse_bitcode(bitcode)
        library._finalize_final_module()
        return compile_result(
            typing_context=target_context.typing_context,
            target_context=target_context,
            entry_point=target_context.get_executable(library, fndesc, env),
            signature=signature,
            library=library,
            fndesc=fndesc,
            environment=env,
            objectmode=False,
            lifted=(),
            reload_init=reload_init,
            referenced_envs=envs,
        )


class _Compiler(Compiler):  # type: ignore[misc]
    def define_pipelines(self) -> Any:
        state = self.state
        if state.flags.no_cpython_wrapper:
            state.library = _InnerLibrary(
                state.targetctx.codegen(), state.func_id.func_qualname
            )
        return super().define_pipelines()


class _Kernel(CPUDispatcher):  # type: ignore[misc]
    """numba's dispatcher; callable from Python, a third of compiling, only where that calls it."""

    def __init__(
        self, function: Callable[..., Any], targetoptions: dict[str, Any]
    ) -> None:
        super().__init__(
            function, targetoptions=targetoptions, pipeline_class=_Compiler
        )
        self._cache = _Cache(function)
        self._inner_cache = _InnerCache(function, ".inner")
        self._inner = False
        self._inner_only = set[tuple[Any, ...]]()

    @property
    def is_warm(self) -> bool:
        return any(cache.is_warm for cache in (self._cache, self._inner_cache))

    def get_call_template(self, args: Any, kws: Any) -> Any:
        """Is called when a kernel that calls this one is compiled."""
        before = self._inner, self._cache
        self._inner = True
        self._cache = self._inner_cache
        self.targetoptions["no_cpython_wrapper"] = True
        try:
            return super().get_call_template(args, kws)
        finally:
            self._inner, self._cache = before
            self.targetoptions["no_cpython_wrapper"] = self._inner

    def compile(self, sig: Any) -> Any:
        with global_compiler_lock:
            args = tuple(normalize_signature(sig)[0])
            if not self._inner and args in self._inner_only:
                self._inner_only.remove(args)
                del self.overloads[args]
            return super().compile(sig)

    def add_overload(self, cres: Any) -> None:
        if not self._inner:  # Python does not see what only kernels can call
            super().add_overload(cres)
            for env in cres._find_referenced_environments():
                cres.library.codegen.set_env(env.env_name, env)
            return
        args = tuple(cres.signature.args)
        self.overloads[args] = cres
        self._inner_only.add(args)


class _Index(IndexDataCacheFile):  # type: ignore[misc]
    def _load_index(self) -> dict[Any, Any]:
        try:
            return dict(super()._load_index())
        except (
            AttributeError,
            ImportError,
        ):  # a class of some arguments is no longer there
            return {}

    def save(self, key: Any, data: Any) -> None:
        """Saves data with what they belong to.

        numba gives them a number in the index first. Of two processes at once, each may give the
        same one; and a process that is ended in between leaves it to data of an earlier version.
        """
        super().save(key, (self._version, key, data))

    def load(self, key: Any) -> Any:
        """Returns the data of a key, or None if there are none: others' would crash."""
        try:
            version, owner, data = super().load(key)
        except (
            AttributeError,
            ImportError,
            TypeError,
            ValueError,
        ):  # none, or of other versions
            return None
        return data if (version, owner) == (self._version, key) else None


class _Cache(FunctionCache):  # type: ignore[misc]
    """Machine code on disk, stamped with the content of all that it was compiled from."""

    def __init__(self, function: Callable[..., Any], kind: str = "") -> None:
        super().__init__(function)
        # Without the line of the function: it may move, and leaves nothing behind.
        name = re.sub(r"-\d+(\.py\d+\w*)$", rf"{kind}\1", self._impl.filename_base)
        stamp = compute_digest(Path(function.__code__.co_filename))
        self._cache_file = _Index(self._cache_path, name, stamp)
        # It is compared before the types are unpickled, whose classes may have other names now.
        self._cache_file._version += stamp

    @property
    def is_warm(self) -> bool:
        return bool(self._cache_file._load_index())


class _InnerCache(_Cache):
    _impl_class = _InnerCacheImpl


@cache
def compute_digest(module: Path) -> str:
    """SHA-256 of a module and of all modules that it imports, directly or not; no library."""
    files = set[Path]()
    left = [module]
    while left:
        file = left.pop()
        if file not in files:
            files.add(file)
            left += imports_of(file)
    parts = sorted((os.path.relpath(file, PACKAGE), _read(file)) for file in files)
    return hashlib.sha256(repr(parts).encode()).hexdigest()


@cache
def _read(file: Path) -> str:
    return file.read_text(encoding="utf-8")


@cache
def imports_of(file: Path) -> tuple[Path, ...]:
    """The modules that a file imports, wherever it does: of the package and of its own folders."""
    own = file.is_relative_to(PACKAGE)
    top = next(
        folder for folder in file.parents if not (folder / "__init__.py").is_file()
    )
    found = list[Path]()
    text = re.sub(r"#[^\n]*|\\\n", " ", _read(file))
    for origin, names, plain in _IMPORT.findall(text):
        for module in re.findall(r"[.\w]+", _ALIAS.sub("", origin or plain)):
            name = module.lstrip(".")
            root = file.parents[len(module) - len(name) - 1] if name != module else top
            if name == module and name.split(".")[0] == PACKAGE.name:
                root = PACKAGE.parent
            elif own and name == module:
                continue
            place = root.joinpath(*name.split("."))
            found += [
                place,
                *(place / each for each in re.findall(r"\w+", _ALIAS.sub("", names))),
            ]
            found += [place / "__init__"] if root != PACKAGE.parent and not own else []
    files = (place.with_suffix(".py") for place in found if place not in {top, PACKAGE})
    return tuple(file for file in files if file.is_file())


def measure_pace_s(compiled: int, spent_s: float) -> float:
    """Returns the time that a kernel takes [s], by those that were compiled so far."""
    return (TRUSTED_AFTER * SECONDS_EACH + spent_s) / (TRUSTED_AFTER + compiled)


def estimate(left: int, compiled: int, spent_s: float) -> str:
    """Tells how long compiling will take: up to `left` kernels, as not all may be called."""
    what = "compiling, once on this machine"
    if left < 1:  # further types of arguments of kernels that were compiled for others
        return f"{what}: the last kernels"
    seconds = max(1, round(left * measure_pace_s(compiled, spent_s)))
    kernels = "1 kernel" if left == 1 else f"{left} kernels"
    return f"{what}, up to {kernels}: about {seconds} s"


class _Compiling(event.Listener):  # type: ignore[misc]
    """Counts what this process compiles, and tells whoever waits how long it will take."""

    def __init__(self) -> None:
        self.count = 0  # specialisations of kernels, and of what they call
        self.cpu_s = 0.0  # CPU time that compiling took
        self.quiet = False  # True: nothing is to be said
        self.patience_s = PATIENCE_S
        self.tell: Callable[[str], None] = STATUS.show
        self._told = -math.inf
        self._lock = threading.Lock()
        self._depth = 0
        self._collects = True
        self._begun = self._begun_cpu = self._spent = 0.0

    def on_start(self, event: event.Event) -> None:
        with self._lock:
            if self._depth == 0:
                self._begun, self._begun_cpu = time.monotonic(), time.thread_time()
                self._collects = gc.isenabled()
                gc.disable()  # a tenth of the time, for next to no garbage
            self._depth += 1
            spent = self._spent + time.monotonic() - self._begun
            silent = time.monotonic() - self._told
            interval = STATUS.interval_s if self.tell == STATUS.show else REPEATED_S
            if spent >= self.patience_s and silent > interval and not self.quiet:
                self._told = time.monotonic()
                left = sum(not each.is_warm for each in KERNELS)
                self.tell(estimate(left, self.count, spent))

    def on_end(self, event: event.Event) -> None:
        with self._lock:
            self._depth = self._depth - 1
            self.count = self.count + 1
            if self._depth == 0:
                if self._collects:
                    gc.enable()
                self._spent += time.monotonic() - self._begun
                STATUS.clear()
                self.cpu_s += time.thread_time() - self._begun_cpu


COMPILING = _Compiling()
event.register("numba:compile", COMPILING)
