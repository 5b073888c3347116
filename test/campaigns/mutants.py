"""Mutation check: the package is broken in one place, and the tests of that room must notice.

    .venv/bin/python test/campaigns/mutants.py --seed 54 --count 120 --out runs/mutants.jsonl

As many mutants come from each room, and within a room each kind takes its turn. Which places are
chosen depends on a hash of the seed, file, function, kind and occurrence, so a seed draws the same
mutants after changes elsewhere. A larger count adds mutants and keeps the others.

Every mutant runs in a copy of the tree as it was at the start. Where `unshare` works, the tests
have processes, network and shared memory of their own, so a mutant can't reach what runs outside.
The test files that import the mutated module run first. A failure counts if it happens twice,
because busy machines fail tests too. Tests that fail without a mutant are left out, as are those
of other rings.

The output has one JSON object per line: the run, each room without a mutant, and each mutant with
its outcome. The same command continues an interrupted run. Controls go through the same steps:
`--control unchanged` has to survive, `--control raises` has to be killed.
"""

from __future__ import annotations

import argparse
import ast
import hashlib
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from itertools import zip_longest
from pathlib import Path
from typing import Any, NamedTuple

from parts.book import Book

ROOT = Path(__file__).resolve().parents[2]
PACKAGE = "nics_drl_bridge"
ROOMS = ("gate", "sim", "lidar", "middleware", "env", "policy", "identify", "nodes")
KINDS = (
    "arithmetic",
    "boolean",
    "boundary",
    "call",
    "comparison",
    "condition",
    "constant",
    "return",
)
KILLED = "killed"
SURVIVED = "survived"
TIMED_OUT = "timed out"  # counts as killed
CONTROLS = {"unchanged": SURVIVED, "raises": KILLED}  # what each has to end with
# What each writes at the end of the room's `__init__.py`.
CONTROL_TEXTS = {"unchanged": "", "raises": "\nraise RuntimeError('control')\n"}

OTHER_RINGS = "not (docs or package or campaign)"
# Time-out of a run: some times the room's time without a mutant, and time to compile kernels [s].
TIMEOUT_FACTOR = 3.0
TIMEOUT_EXTRA_S = 600.0
CLEAN_TIMEOUT_S = 3 * 3600.0
NO_TESTS = 5  # pytest's exit code when no test was collected


def _pair(*pairs: str) -> dict[str, str]:
    """Returns each name of a pair by the other one."""
    names = [pair.split() for pair in pairs]
    return dict([*names, *(pair[::-1] for pair in names)])


# Operators and what replaces them, by kind.
COMPARED = _pair("Lt Gt", "LtE GtE", "Eq NotEq", "Is IsNot", "In NotIn")
SHIFTED = _pair("Lt LtE", "Gt GtE")
CALCULATED = {
    "Add": "Sub",
    "Sub": "Add",
    "Mult": "Div",
    "Div": "Mult",
    **dict.fromkeys(("FloorDiv", "Mod", "Pow"), "Mult"),
}
# Conditions on the machine or on the way a module is run; here they have one outcome.
MACHINE = {"TYPE_CHECKING", "__name__", "platform", "version_info"}
UNCHECKED_CALLS = {"prefetch"}  # changes the speed alone
UNCHECKED_KEYWORDS = {"strict"}  # of `zip`: guards against a mistake in the code itself
TEXTS = (ast.JoinedStr, ast.List, ast.Tuple, ast.ListComp)

# The processes end together, and their network is a loopback device with multicast.
PREPARE = """
mount -t tmpfs none /dev/shm &&
ip link set lo up multicast on &&
ip route add 224.0.0.0/4 dev lo &&
"$@"
exit $?
"""
ISOLATE = (
    *("unshare", "--mount", "--pid", "--net", "--ipc"),
    *("--fork", "--kill-child", "--mount-proc", "sh", "-c", PREPARE, "sh"),
)


@dataclass(frozen=True)
class Mutant:
    """One place of the source that is changed."""

    room: str
    file: str  # from the root of the tree
    function: str  # qualified name; "" at the level of the module
    kind: str
    occurrence: int  # number of the place in its function among those of its kind
    line: int = 0

    @property
    def key(self) -> str:
        return f"{self.file}:{self.function}:{self.kind}:{self.occurrence}"

    def write(self, source: str) -> str:
        """Returns the source with this place changed, formatted anew and without comments."""
        if self.kind in CONTROLS:
            return source + CONTROL_TEXTS[self.kind]
        sites = _Sites()
        tree = ast.parse(source)
        sites.visit(tree)
        sites.changes[self.function, self.kind][self.occurrence][1]()
        return ast.unparse(tree) + "\n"

    def describe(self, source: str) -> dict[str, Any]:
        """Returns what identifies the mutant for a reader."""
        before = ast.unparse(ast.parse(source)).split("\n")
        after = self.write(source).split("\n")
        pairs = zip_longest(before, after, fillvalue="")
        old, new = next((pair for pair in pairs if pair[0] != pair[1]), ("", ""))
        return asdict(self) | {"before": old.strip(), "after": new.strip()}


class Run(NamedTuple):
    """How one call of pytest ended."""

    code: int | None  # None: timed out
    seconds: float
    failed: list[str]  # ids of tests, or files that could not be collected
    last_line: str


class Clean(NamedTuple):
    """The tests of a room without a mutant."""

    seconds: float
    failed: list[str]


class _Sites(ast.NodeVisitor):
    """Finds the places of one file that can be changed, by function and kind."""

    def __init__(self) -> None:
        self.changes: dict[tuple[str, str], list[tuple[int, Callable[[], None]]]]
        self.changes = defaultdict(list)
        self._names: list[str] = []

    def _add(self, kind: str, node: ast.AST, **fields: Any) -> None:
        """Adds a change of some fields of a node."""

        def change() -> None:
            vars(node).update(fields)

        self._note(kind, node, change)

    def _replace(self, kind: str, node: ast.AST, other: ast.AST) -> None:
        """Adds a change of a node into another one."""

        def change() -> None:
            content = dict(vars(other))
            node.__class__ = other.__class__
            vars(node).clear()
            vars(node).update(content)

        self._note(kind, node, change)

    def _note(self, kind: str, node: Any, change: Callable[[], None]) -> None:
        place = (".".join(self._names), kind)
        self.changes[place].append((node.lineno, change))

    def _visit_all(self, nodes: Sequence[ast.AST | None]) -> None:
        for node in nodes:
            if node is not None:
                self.visit(node)

    def _visit_definition(
        self, node: ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef
    ) -> None:
        self._names.append(node.name)
        if not isinstance(node, ast.ClassDef):
            self._visit_all([*node.args.defaults, *node.args.kw_defaults])
        self._visit_all(node.body)
        self._names.pop()

    visit_FunctionDef = _visit_definition  # noqa: N815
    visit_AsyncFunctionDef = _visit_definition  # noqa: N815
    visit_ClassDef = _visit_definition  # noqa: N815

    def visit_Lambda(self, node: ast.Lambda) -> None:
        self._visit_all([*node.args.defaults, *node.args.kw_defaults, node.body])

    def visit_AnnAssign(self, node: ast.AnnAssign) -> None:
        self._visit_all([node.value])

    def visit_Assign(self, node: ast.Assign) -> None:
        if not any(isinstance(x, ast.Name) and x.id == "__all__" for x in node.targets):
            self.generic_visit(node)

    def visit_Raise(self, node: ast.Raise) -> None:
        """Skips the error, whose numbers and choices are those of a message."""

    def visit_Assert(self, node: ast.Assert) -> None:
        """Skips what is never false."""

    def visit_JoinedStr(self, node: ast.JoinedStr) -> None:
        """Skips texts; Python 3.11 does not say where their parts stand."""

    def visit_keyword(self, node: ast.keyword) -> None:
        if node.arg not in UNCHECKED_KEYWORDS:
            self.generic_visit(node)

    def visit_Compare(self, node: ast.Compare) -> None:
        for number, operator in enumerate(node.ops):
            for kind, others in (("comparison", COMPARED), ("boundary", SHIFTED)):
                if other := _find_other(operator, others):
                    changed = [*node.ops[:number], other, *node.ops[number + 1 :]]
                    self._add(kind, node, ops=changed)
        self.generic_visit(node)

    def visit_BoolOp(self, node: ast.BoolOp) -> None:
        values = node.values
        for end in range(1, len(values)):
            if isinstance(node.op, ast.And):
                sides = [_join(ast.And(), x) for x in (values[:end], values[end:])]
                self._add("boolean", node, op=ast.Or(), values=sides)
            else:
                pair = _join(ast.And(), values[end - 1 : end + 1])
                others = [*values[: end - 1], pair, *values[end + 1 :]]
                self._replace("boolean", node, _join(ast.Or(), others))
        self.generic_visit(node)

    def visit_BinOp(self, node: ast.BinOp) -> None:
        if not any(_is_text(x) for x in (node.left, node.right)):
            self._add_arithmetic(node)
        self.generic_visit(node)

    def visit_AugAssign(self, node: ast.AugAssign) -> None:
        if not _is_text(node.value):
            self._add_arithmetic(node)
        self.generic_visit(node)

    def _add_arithmetic(self, node: ast.BinOp | ast.AugAssign) -> None:
        if other := _find_other(node.op, CALCULATED):
            self._add("arithmetic", node, op=other)

    def visit_UnaryOp(self, node: ast.UnaryOp) -> None:
        if isinstance(node.op, ast.Not | ast.Invert):
            self._replace("boolean", node, node.operand)
        elif isinstance(node.op, ast.USub) and not isinstance(
            node.operand, ast.Constant
        ):
            self._replace("arithmetic", node, node.operand)
        self.generic_visit(node)

    def visit_Constant(self, node: ast.Constant) -> None:
        value = node.value
        if isinstance(value, bool):
            self._add("boolean", node, value=not value)
        elif isinstance(value, int | float):
            larger = value + 1 if value + 1 != value else value * 2
            self._add("constant", node, value=larger)

    def visit_If(self, node: ast.If) -> None:
        if {_get_name(part) for part in ast.walk(node.test)} & MACHINE:
            self._visit_all(node.orelse)
            return
        self._add_condition(node.test, True, False)
        self.generic_visit(node)

    def visit_IfExp(self, node: ast.IfExp) -> None:
        self._add_condition(node.test, True, False)
        self.generic_visit(node)

    def visit_While(self, node: ast.While) -> None:
        self._add_condition(node.test, False)  # True would only time out
        self.generic_visit(node)

    def visit_comprehension(self, node: ast.comprehension) -> None:
        for condition in node.ifs:
            self._add_condition(condition, True, False)
        self.generic_visit(node)

    def _add_condition(self, condition: ast.expr, *outcomes: bool) -> None:
        if isinstance(condition, ast.Constant):
            return
        for outcome in outcomes:
            self._replace("condition", condition, ast.Constant(outcome))

    def visit_Return(self, node: ast.Return) -> None:
        # What is false already is the same to most callers as None.
        if node.value is not None and not (
            isinstance(node.value, ast.Constant) and not node.value.value
        ):
            self._add("return", node, value=ast.Constant(None))
        self.generic_visit(node)

    def visit_Expr(self, node: ast.Expr) -> None:
        if isinstance(node.value, ast.Call):
            if _get_name(node.value.func) in UNCHECKED_CALLS:
                return
            self._replace("call", node, ast.Pass())
        self.generic_visit(node)


def _get_name(node: ast.AST) -> str:
    """Returns the name of a variable or attribute."""
    return getattr(node, "id", "") or getattr(node, "attr", "")


def _find_other(operator: ast.AST, others: dict[str, str]) -> Any:
    """Returns the operator that replaces another one, or None."""
    name = others.get(type(operator).__name__)
    return name and getattr(ast, name)()


def _join(operator: ast.boolop, values: list[ast.expr]) -> ast.expr:
    return values[0] if len(values) == 1 else ast.BoolOp(operator, values)


def _is_text(node: ast.expr) -> bool:
    """Whether an operand is a text, path or list, with which most operators fail at once."""
    is_string = isinstance(node, ast.Constant) and isinstance(node.value, str | bytes)
    return is_string or isinstance(node, TEXTS)


def find_mutants(tree: Path, room: str) -> list[Mutant]:
    """Returns all mutants of a room."""
    mutants: list[Mutant] = []
    for path in sorted((tree / PACKAGE / room).rglob("*.py")):
        file = path.relative_to(tree).as_posix()
        sites = _Sites()
        sites.visit(ast.parse(path.read_bytes()))
        for (function, kind), changes in sites.changes.items():
            mutants += [
                Mutant(room, file, function, kind, number, line)
                for number, (line, _) in enumerate(changes)
            ]
    return mutants


def rank(seed: int, key: str) -> str:
    """Returns where a key stands in the order of a seed."""
    return hashlib.sha256(f"{seed}:{key}".encode()).hexdigest()


def draw(tree: Path, seed: int, rooms: Sequence[str], count: int) -> list[Mutant]:
    """Returns as many mutants of each room, and of each kind, as far as that goes."""
    drawn: list[Mutant] = []
    for index, room in enumerate(rooms):
        quota = count // len(rooms) + (index < count % len(rooms))
        mutants = find_mutants(tree, room)
        kinds = sorted(KINDS, key=lambda kind: rank(seed, f"{room}:{kind}"))
        order = {kind: number for number, kind in enumerate(kinds)}
        # The first of each kind, then the second of each kind, and so on.
        turns: Counter[str] = Counter()
        queue: list[tuple[int, int, Mutant]] = []
        for mutant in sorted(mutants, key=lambda each: rank(seed, each.key)):
            queue.append((turns[mutant.kind], order[mutant.kind], mutant))
            turns[mutant.kind] += 1
        queue.sort(key=lambda entry: entry[:2])
        drawn += [mutant for _, _, mutant in queue[:quota]]
    return drawn


def order_tests(tree: Path, mutant_file: str, room: str) -> list[str]:
    """Returns the test files of a room: the module's own, those that import it, the others."""
    module = Path(mutant_file).stem
    folder = tree / "test" / room

    def distance(file: Path) -> tuple[int, Path]:
        if file.name == f"test_{module}.py":
            return 0, file
        imports = rf"^(from|import)\b[^\n]*(\([^)]*)?\b{module}\b"
        found = re.search(imports, file.read_text(encoding="utf-8"), re.MULTILINE)
        return (1 if found else 2), file

    files = sorted(folder.rglob("test_*.py"), key=distance)
    return [file.relative_to(tree).as_posix() for file in files]


def copy_tree(source: Path, target: Path) -> None:
    """Copies the sources and the compiled kernels."""
    left_out = (".git", ".venv", ".nox", "runs", "build", "*.pyc", ".*_cache")
    shutil.copytree(
        source, target, symlinks=True, ignore=shutil.ignore_patterns(*left_out)
    )


def copy_snapshot(snapshot: Path, target: Path) -> None:
    """Copies the snapshot; compiled files are linked, because they are only ever replaced."""

    def copy(source: str, place: str) -> None:
        if source.endswith((".nbi", ".nbc")):
            os.link(source, place)
        else:
            shutil.copy2(source, place)

    shutil.rmtree(target, ignore_errors=True)
    ignored = shutil.ignore_patterns("*.pyc", ".pytest_cache")
    shutil.copytree(snapshot, target, symlinks=True, ignore=ignored, copy_function=copy)


def compute_digest(tree: Path) -> str:
    """Returns the SHA-256 of the source of the package and its tests, without campaigns."""
    digest = hashlib.sha256()
    for folder in (PACKAGE, "test"):
        for file in sorted((tree / folder).rglob("*.py")):
            if file.is_relative_to(tree / "test" / "campaigns"):
                continue
            digest.update(file.relative_to(tree).as_posix().encode() + b"\0")
            digest.update(file.read_bytes() + b"\0")
    return digest.hexdigest()


class Laboratory:
    """Copies of the tree, in which commands run with the package of that copy."""

    def __init__(self, folder: Path, root: Path) -> None:
        self.folder = folder
        self.snapshot = folder / "snapshot"
        copy_tree(root, self.snapshot)
        # The real recordings lie beside the repository.
        (folder / "shared").symlink_to(root.parent / "shared")
        self.isolated = self._can_isolate()
        self._check_import(self.snapshot)

    def _can_isolate(self) -> bool:
        if shutil.which("unshare") is None or shutil.which("ip") is None:
            return False
        return subprocess.run([*ISOLATE, "true"], capture_output=True).returncode == 0

    def _check_import(self, tree: Path) -> None:
        """Refuses to go on if another tree's package would be tested."""
        code, text, _ = self.call(
            tree, ["-c", f"import {PACKAGE} as p; print(p.__file__)"], 600.0
        )
        if code != 0 or not text.strip().endswith(str(tree / PACKAGE / "__init__.py")):
            raise SystemExit(f"mutants: the package of {tree} is not imported: {text}")

    def call(
        self, tree: Path, words: Sequence[str], timeout_s: float
    ) -> tuple[int | None, str, float]:
        """Runs Python in a tree; returns exit code (None: timed out), output and seconds."""
        path = os.pathsep.join(filter(None, [str(tree), os.environ.get("PYTHONPATH")]))
        dropped = ("PYTHONDONTWRITEBYTECODE", "NUMBA_CACHE_DIR", "PYTEST_ADDOPTS")
        environment = {k: v for k, v in os.environ.items() if k not in dropped}
        environment["PYTHONPATH"] = path
        command = [*(ISOLATE if self.isolated else ()), sys.executable, *words]
        begun = time.monotonic()
        with tempfile.TemporaryFile() as output:
            process = subprocess.Popen(
                command,
                cwd=tree,
                env=environment,
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=subprocess.STDOUT,
                start_new_session=True,
            )
            code: int | None = None
            try:
                with suppress(subprocess.TimeoutExpired):
                    code = process.wait(timeout_s)
            finally:
                # `unshare` ends all that left the session with itself.
                with suppress(ProcessLookupError):
                    os.killpg(process.pid, signal.SIGKILL)
                process.wait()
            output.seek(0)
            text = output.read().decode(errors="replace")
        return code, text, time.monotonic() - begun

    def warm_up(self) -> None:
        """Compiles all kernels of the snapshot, most of which were copied."""
        self.call(
            self.snapshot,
            ["-m", f"{PACKAGE}.commands.start", "warmup", "--all"],
            CLEAN_TIMEOUT_S,
        )

    def run_tests(
        self, tree: Path, tests: Sequence[str], timeout_s: float, *options: str
    ) -> Run:
        """Runs tests, files or single ones, in a tree."""
        shutil.rmtree(tree / ".pytest_cache", ignore_errors=True)
        words = ["-m", "pytest", "-q", "-m", OTHER_RINGS, *options]
        words.append(f"--basetemp={tree.parent / (tree.name + '-temp')}")
        code, text, seconds = self.call(tree, [*words, *tests], timeout_s)
        cache = tree / ".pytest_cache" / "v" / "cache" / "lastfailed"
        failed = list(json.loads(cache.read_text())) if cache.is_file() else []
        last_line = (text.strip().splitlines() or [""])[-1]
        return Run(code, seconds, failed, last_line)

    def run_clean(self, room: str) -> Clean:
        """Runs the tests of a room without a mutant."""
        files = order_tests(self.snapshot, "", room)
        run = self.run_tests(self.snapshot, files, CLEAN_TIMEOUT_S)
        if run.code not in (0, 1):
            raise SystemExit(f"mutants: {room} can't be tested: {run.last_line}")
        failed = run.failed
        if failed:
            failed = self.run_tests(self.snapshot, failed, CLEAN_TIMEOUT_S).failed
        return Clean(run.seconds, failed)

    def run_mutant(self, mutant: Mutant, clean: Clean) -> dict[str, Any]:
        """Writes a mutant into a copy of the snapshot and returns how its tests ended."""
        tree = self.folder / "tree"
        copy_snapshot(self.snapshot, tree)
        file = tree / mutant.file
        source = file.read_text(encoding="utf-8")
        file.write_text(mutant.write(source), encoding="utf-8")
        timeout_s = TIMEOUT_FACTOR * clean.seconds + TIMEOUT_EXTRA_S
        left_out = list(clean.failed)
        unsteady: list[str] = []
        files = order_tests(self.snapshot, mutant.file, mutant.room)
        record = mutant.describe(source)
        begun = time.monotonic()
        while True:
            options = [f"--deselect={test}" for test in left_out]
            run = self.run_tests(tree, files, timeout_s, "-x", *options)
            outcome = judge(run)
            if outcome != KILLED or not run.failed:
                break
            again = self.run_tests(tree, run.failed, timeout_s)
            if again.code != 0:
                outcome = judge(again)
                break
            # The files before that of the unsteady test have passed.
            unsteady += run.failed
            left_out += run.failed
            files = files[files.index(run.failed[0].partition("::")[0]) :]
        record["outcome"] = outcome
        record["by"] = run.failed[0] if run.failed and outcome != SURVIVED else ""
        record["last_line"] = run.last_line
        record["unsteady"] = unsteady
        record["seconds"] = round(time.monotonic() - begun, 1)
        return record


def judge(run: Run) -> str:
    """Returns what the end of a run says about its mutant."""
    if run.code is None:
        return TIMED_OUT
    return SURVIVED if run.code in (0, NO_TESTS) else KILLED


def summarise(records: Sequence[dict[str, Any]], rooms: Sequence[str]) -> str:
    """Returns a line for the outcomes in each room, and the mutants that survived."""
    lines = []
    for room in [*rooms, "all"]:
        outcomes = [x["outcome"] for x in records if room in (x["room"], "all")]
        found = len(outcomes) - outcomes.count(SURVIVED)
        timed_out = f"{outcomes.count(TIMED_OUT)} by a time-out"
        lines.append(f"{room:<12}{found} of {len(outcomes)} found, {timed_out}")
    for x in records:
        if x["outcome"] == SURVIVED:
            place = f"{x['file']}:{x['line']} {x['function']} ({x['kind']})"
            lines.append(f"{place}\n    - {x['before']}\n    + {x['after']}")
    return "\n".join(lines)


def key_of(record: dict[str, Any]) -> str:
    """Returns the key of the mutant of a record, as `Mutant.key`."""
    return ":".join(
        str(record[name]) for name in ("file", "function", "kind", "occurrence")
    )


def parse_arguments(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--seed", type=int, default=54, help="of the draw")
    parser.add_argument("--count", type=int, default=120, help="mutants of all rooms")
    parser.add_argument(
        "--rooms", nargs="+", choices=ROOMS, default=ROOMS, help="in this order"
    )
    parser.add_argument("--out", type=Path, default=ROOT / "runs" / "mutants.jsonl")
    parser.add_argument("--control", choices=CONTROLS, help="instead of mutants")
    parser.add_argument("--list", action="store_true", help="list the mutants only")
    return parser.parse_args(arguments)


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the mutants; returns 1 if a control did not end as it has to."""
    asked = parse_arguments(arguments)
    # The end of this process ends the tests and removes the copies.
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(128 + signal.SIGTERM))
    if asked.control:
        mutants = [
            Mutant(room, f"{PACKAGE}/{room}/__init__.py", "", asked.control, 0)
            for room in asked.rooms
        ]
    else:
        mutants = draw(ROOT, asked.seed, asked.rooms, asked.count)
    if asked.list:
        for mutant in mutants:
            source = (ROOT / mutant.file).read_text(encoding="utf-8")
            print(json.dumps(mutant.describe(source)))
        return 0
    with tempfile.TemporaryDirectory(prefix="mutants-") as folder:
        laboratory = Laboratory(Path(folder), ROOT)
        run = {
            "seed": asked.seed,
            "control": asked.control,
            "digest": compute_digest(laboratory.snapshot),
            "isolated": laboratory.isolated,
        }
        asked.out.parent.mkdir(parents=True, exist_ok=True)
        book = Book(asked.out, run)
        laboratory.warm_up()
        for room in asked.rooms:
            own = [mutant for mutant in mutants if mutant.room == room]
            test_room(laboratory, room, own, book)
    keys = {mutant.key for mutant in mutants}
    results = [x for x in book.rows if x["record"] == "mutant" and key_of(x) in keys]
    print(summarise(results, asked.rooms))
    expected = CONTROLS.get(asked.control)
    return int(expected is not None and {x["outcome"] for x in results} != {expected})


def test_room(
    laboratory: Laboratory,
    room: str,
    mutants: Sequence[Mutant],
    book: Book,
) -> None:
    """Runs those mutants of a room that have no record yet."""
    done = {key_of(row) for row in book.rows if row["record"] == "mutant"}
    left = [mutant for mutant in mutants if mutant.key not in done]
    if not left:
        return
    earlier = [x for x in book.rows if x["record"] == "clean" and x["room"] == room]
    if earlier:
        clean = Clean(earlier[0]["seconds"], earlier[0]["failed"])
    else:
        clean = laboratory.run_clean(room)
        book.add([{"record": "clean", "room": room, **clean._asdict()}])
    print(
        f"{room}: {clean.seconds:.0f} s, fail without a mutant: {clean.failed}",
        flush=True,
    )
    for mutant in left:
        record = laboratory.run_mutant(mutant, clean)
        book.add([{"record": "mutant", **record}])
        place = f"{record['file']}:{record['line']} {record['kind']}"
        print(f"{record['outcome']:<10} {record['seconds']:>6} s  {place}", flush=True)


if __name__ == "__main__":
    sys.exit(main())
