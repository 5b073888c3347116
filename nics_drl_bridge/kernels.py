"""`@kernel`: compiles functions, caches their machine code on disk, and keeps it up to date.

numba itself checks only the file that defines a function. Here, cached code is valid until that
module changes, or any module that it imports, directly or not, from this package or from the
folder of a user's own kernel.

A wheel may carry machine code for `TARGET`, which most x86 machines run; it is loaded if the
cache has none. On other machines, and after an edit, the kernels are compiled as usual.
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
from numba import types
from numba.core import event
from numba.core.caching import CompileResultCacheImpl, FunctionCache, IndexDataCacheFile
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import Compiler, compile_result
from numba.core.compiler_lock import global_compiler_lock
from numba.core.registry import CPUDispatcher
from numba.core.sigutils import normalize_signature
from numba.experimental import structref

from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.status import REPEATED_S, STATUS

PACKAGE = Path(__file__).parent
TARGET = "x86-64-v3"
# CPU features of `TARGET` beyond the first x86-64, by LLVM's names
TARGET_FEATURES = ("avx2", "bmi", "bmi2", "f16c", "fma", "lzcnt", "movbe")
CARRIED = PACKAGE / "machine_code"  # in the wheel; a checkout has no such folder
PATIENCE_S = 2.0  # if compiling takes longer, standard error says so
SECONDS_EACH = 0.5  # typical time to compile a kernel with its helpers [s]
TRUSTED_AFTER = 5  # kernels after which the measured pace weighs as much
KERNELS: list[Any] = []  # numba dispatchers of all kernels imported so far
_IMPORT = re.compile(
    r"^[ \t]*(?:from[ \t]+([.\w]+)[ \t]+import[ \t]+(\([^)]*\)|[^\n]*)|import[ \t]+([^\n]*))",
    re.MULTILINE,
)
_ALIAS = re.compile(r"\bas\s+\w+")


def kernel(
    function: Callable[..., Any] | None = None,
    *,
    allocates: bool = False,
    contracts: bool = False,
    inline: bool = False,
    view: bool = False,
) -> Callable[..., Any]:
    """Compiles a function with numba at its first call, or loads it from the cache.

    It runs without the interpreter lock; a division by zero gives inf or NaN.

    Args:
        function: the function.
        allocates: True if it or a kernel that it calls allocates arrays or other objects.
        contracts: True to fuse multiplications and additions, with one rounding.
        inline: True to inline the machine code into all callers, if measured to be faster.
        view: True if it returns parts of its arguments' arrays; its source is inlined.
    """
    if function is None:
        return partial(
            kernel, allocates=allocates, contracts=contracts, inline=inline, view=view
        )
    options: dict[str, Any] = {"nopython": True, "nogil": True, "error_model": "numpy"}
    options |= {"boundscheck": None, "no_cfunc_wrapper": True}
    # All options are set; numba would take missing ones from the first kernel that calls this one.
    options |= {"_nrt": allocates, "forceinline": inline}
    options |= {"fastmath": {"contract"} if contracts else False}
    options |= {"inline": "always"} if view else {}
    compiled: Callable[..., Any] = _Kernel(function, targetoptions=options)
    KERNELS.append(compiled)
    return compiled


def bind(compiled: Callable[..., Any], *arguments: Any) -> Callable[[], Any]:
    """Binds a kernel to arguments that change in place: a call then takes a third of the time.

    Otherwise numba determines the types of all arguments in each call.
    """
    dispatcher: Any = compiled
    types_of_arguments = tuple(map(dispatcher.typeof_pyval, arguments))
    return partial(dispatcher.compile(types_of_arguments), *arguments)


class _InnerLibrary(JITCodeLibrary):  # type: ignore[misc]
    """Code that only kernels call; it is optimised and compiled as part of its callers."""

    @property
    def codegen(self) -> Any:
        """Returns the library itself, which keeps no environments because its code never runs."""
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
    """numba's dispatcher; makes the Python wrapper, a third of compile time, only if needed."""

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
        """Called by numba when it compiles a kernel that calls this one.

        A literal argument counts as its type, or each number would be compiled anew.
        """
        args = tuple(map(types.unliteral, args))
        kws = {name: types.unliteral(given) for name, given in kws.items()}
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
        if not self._inner:  # Python may call it
            super().add_overload(cres)
            for env in cres._find_referenced_environments():
                cres.library.codegen.set_env(env.env_name, env)
            return
        args = tuple(cres.signature.args)
        self.overloads[args] = cres
        self._inner_only.add(args)


class _Index(IndexDataCacheFile):  # type: ignore[misc]
    def __init__(self, folder: str, name: str, stamp: str) -> None:
        super().__init__(folder, name, stamp)
        # The version is compared before types are unpickled: their classes may have been renamed.
        self._version += stamp

    def _load_index(self) -> dict[Any, Any]:
        try:
            return dict(super()._load_index())
        except (AttributeError, ImportError):  # an argument's class no longer exists
            return {}

    def save(self, key: Any, data: Any) -> None:
        """Saves data with its version and key.

        numba first enters a file number into its index. Two processes may choose the same number,
        and a process killed before it writes the file leaves the number pointing to older data.
        """
        super().save(key, (self._version, key, data))

    def load(self, key: Any) -> Any:
        """Returns the data of a key, or None; the data of another key would crash."""
        try:
            version, owner, data = super().load(key)
        except (AttributeError, ImportError, TypeError, ValueError):
            return None  # nothing is cached, or another version wrote it
        return data if (version, owner) == (self._version, key) else None


class _Target:
    """Stands for numba's code generator in the key of machine code for `TARGET`."""

    @staticmethod
    def magic_tuple() -> tuple[str, str, str]:
        return llvm.get_process_triple(), TARGET, ""


@cache
def runs_target() -> bool:
    """True if this machine runs machine code for `TARGET`."""
    try:
        features = llvm.get_host_cpu_features()
    except RuntimeError:  # LLVM does not know this machine
        return False
    return all(features.get(name, False) for name in TARGET_FEATURES)


def compile_for_wheel() -> None:
    """Makes this process write the code of the kernels that it imports into `CARRIED`.

    numba compiles for `TARGET` if NUMBA_CPU_NAME and NUMBA_CPU_FEATURES said so at its import.
    """
    CARRIED.mkdir(exist_ok=True)
    _Cache.writes_carried = True


class _Cache(FunctionCache):  # type: ignore[misc]
    """Machine code on disk, stamped with a digest of all the sources it was compiled from."""

    writes_carried = False

    def __init__(self, function: Callable[..., Any], kind: str = "") -> None:
        try:
            super().__init__(function)
        except RuntimeError as error:  # no folder can be written to
            fix = "set NUMBA_CACHE_DIR to a folder that can be written to"
            raise ConfigError(f"kernels: {error}; {fix}.") from None
        # Without the line number in the name, a function that moved overwrites its old file.
        name = re.sub(r"-\d+(\.py\d+\w*)$", rf"{kind}\1", self._impl.filename_base)
        stamp = compute_digest(Path(function.__code__.co_filename))
        self._cache_file = _Index(self._cache_path, name, stamp)
        self._carried: _Index | None = None
        file = Path(function.__code__.co_filename)
        if not kind and file.is_relative_to(PACKAGE):
            parts = (*file.relative_to(PACKAGE).parent.parts, name)
            self._carried = _Index(str(CARRIED), ".".join(parts), stamp)

    @property
    def is_warm(self) -> bool:
        return any(
            index._load_index() for index in (self._cache_file, self._carried) if index
        )

    def _save_overload(self, signature: Any, data: Any) -> None:
        kept = self._cache_file
        if self.writes_carried and self._carried is not None:
            self._cache_file = self._carried
        try:
            super()._save_overload(signature, data)
        finally:
            self._cache_file = kept

    def _load_overload(self, signature: Any, target_context: Any) -> Any:
        overload = super()._load_overload(signature, target_context)
        if overload is not None or self._carried is None or not runs_target():
            return overload
        data = self._carried.load(self._index_key(signature, _Target))
        return None if data is None else self._impl.rebuild(target_context, data)


class _InnerCache(_Cache):
    _impl_class = _InnerCacheImpl


@cache
def compute_digest(module: Path) -> str:
    """Returns the SHA-256 of a module and its imports, direct or not, without libraries."""
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
    """Returns the modules that a file imports from this package or its own folder."""
    is_own = file.is_relative_to(PACKAGE)
    top = next(
        folder for folder in file.parents if not (folder / "__init__.py").is_file()
    )
    places = list[Path]()
    text = re.sub(r"#[^\n]*|\\\n", " ", _read(file))
    for origin, names, plain in _IMPORT.findall(text):
        for module in re.findall(r"[.\w]+", _ALIAS.sub("", origin or plain)):
            name = module.lstrip(".")
            root = file.parents[len(module) - len(name) - 1] if name != module else top
            if name == module and name.split(".")[0] == PACKAGE.name:
                root = PACKAGE.parent
            elif is_own and name == module:
                continue
            place = root.joinpath(*name.split("."))
            places += [
                place,
                *(place / word for word in re.findall(r"\w+", _ALIAS.sub("", names))),
            ]
            places += (
                [place / "__init__"] if root != PACKAGE.parent and not is_own else []
            )
    files = (
        place.with_suffix(".py") for place in places if place not in {top, PACKAGE}
    )
    return tuple(file for file in files if file.is_file())


def measure_pace_s(compiled: int, spent_s: float) -> float:
    """Returns the time per kernel [s], estimated from the kernels compiled so far."""
    return (TRUSTED_AFTER * SECONDS_EACH + spent_s) / (TRUSTED_AFTER + compiled)


def estimate(left: int, compiled: int, spent_s: float) -> str:
    """Describes how long compiling will take: up to `left` kernels, because some may be unused."""
    what = "compiling, once on this machine"
    if left < 1:  # only kernels that were already compiled for other argument types
        return f"{what}: the last kernels"
    seconds = max(1, round(left * measure_pace_s(compiled, spent_s)))
    kernels = "1 kernel" if left == 1 else f"{left} kernels"
    return f"{what}, up to {kernels}: about {seconds} s"


class _Compiling(event.Listener):  # type: ignore[misc]
    """Counts what this process compiles, and tells the user how long it will take."""

    def __init__(self) -> None:
        self.count = 0  # compiled functions, one per set of argument types
        self.cpu_s = 0.0  # CPU time that compiling took
        self.quiet = False  # True: report nothing
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
                gc.disable()  # It would take a tenth of the time and free almost nothing.
            self._depth += 1
            spent = self._spent + time.monotonic() - self._begun
            silent = time.monotonic() - self._told
            interval = STATUS.interval_s if self.tell == STATUS.show else REPEATED_S
            if spent >= self.patience_s and silent > interval and not self.quiet:
                self._told = time.monotonic()
                left = sum(not kernel.is_warm for kernel in KERNELS)
                self.tell(estimate(left, self.count, spent))

    def on_end(self, event: event.Event) -> None:
        with self._lock:
            self._depth -= 1
            self.count += 1
            if self._depth == 0:
                if self._collects:
                    gc.enable()
                self._spent += time.monotonic() - self._begun
                STATUS.clear()
                self.cpu_s += time.thread_time() - self._begun_cpu


COMPILING = _Compiling()
event.register("numba:compile", COMPILING)


@structref.register
class PackedType(types.StructRef):  # type: ignore[misc]
    """The type of `Packed`."""


class Packed(structref.StructRefProxy):  # type: ignore[misc]
    """Many arrays as one argument of a kernel: passing a hundred takes longer than a step.

    In a kernel, `packed.content` is the NamedTuple of arrays.
    """


structref.define_proxy(Packed, PackedType, ["content"])


@kernel(allocates=True)
def pack(content: Any) -> Any:
    """Packs a NamedTuple into one argument."""
    return Packed(content)
