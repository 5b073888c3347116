"""Figures of a package's source, computed from its syntax trees; nothing is imported or run."""

from __future__ import annotations

import ast
from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

Function = ast.FunctionDef | ast.AsyncFunctionDef
INDIRECT = ("What", "Whether", "How", "Who", "Which", "Why")
"""A docstring that begins so asks instead of saying what the thing does or is."""
KERNEL = "kernel"
MANY = 3
"""A tuple of so many is to have names."""


@dataclass(frozen=True)
class Module:
    """One file.

    Attributes:
        name: in full, with dots.
        path: of the file.
        lines: of all kinds.
        tree: its syntax.
        package: whether it is the `__init__` of a folder.
    """

    name: str
    path: Path
    lines: int
    tree: ast.Module
    package: bool


@dataclass
class Places:
    """Where each figure comes from: `file:line name` by the figure's name."""

    found: dict[str, list[str]] = field(default_factory=lambda: defaultdict(list))

    def add(self, figure: str, module: Module, node: ast.AST, what: str) -> None:
        """Notes one place."""
        self.found[figure].append(f"{module.path}:{getattr(node, 'lineno', 1)} {what}")


def read(folder: Path) -> list[Module]:
    """Every module of a package, sorted by name."""
    modules = []
    for path in sorted(folder.rglob("*.py")):
        parts = [folder.name, *path.relative_to(folder).with_suffix("").parts]
        package = parts[-1] == "__init__"
        text = path.read_text(encoding="utf-8")
        name = ".".join(parts[:-1] if package else parts)
        modules.append(Module(name, path, text.count("\n"), ast.parse(text), package))
    return modules


def imports(module: Module, known: Mapping[str, Module]) -> set[str]:
    """The modules of the same package that a module imports, wherever in the file."""
    found: set[str] = set()
    for node in ast.walk(module.tree):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            here = module.name.split(".") + ([""] if module.package else [])
            above = here[: len(here) - node.level] if node.level else []
            origin = ".".join([*above, *([node.module] if node.module else [])])
            names = {f"{origin}.{alias.name}" for alias in node.names}
            found |= {name if name in known else origin for name in names}
    return {name for name in found if name in known and name != module.name}


def circles(edges: Mapping[str, set[str]]) -> list[list[str]]:
    """Groups of modules that import each other, by Tarjan's strongly connected components."""
    order: dict[str, int] = {}
    low: dict[str, int] = {}
    stack: list[str] = []
    groups = []

    def visit(name: str) -> None:
        order[name] = low[name] = len(order)
        stack.append(name)
        for other in sorted(edges[name]):
            if other not in order:
                visit(other)
            if other in stack:
                low[name] = min(low[name], low[other])
        if low[name] == order[name]:
            group = [stack.pop()]
            while group[-1] != name:
                group.append(stack.pop())
            groups.append(sorted(group))

    for name in sorted(edges):
        if name not in order:
            visit(name)
    return [group for group in groups if len(group) > 1]


def functions(module: Module) -> Iterator[Function]:
    """Every function of a module, methods and inner ones too."""
    for node in ast.walk(module.tree):
        if isinstance(node, Function):
            yield node


def arguments(function: Function) -> int:
    """How many arguments a function takes, `self` and `cls` aside."""
    given = function.args
    names = [each.arg for each in (*given.posonlyargs, *given.args, *given.kwonlyargs)]
    names += [each.arg for each in (given.vararg, given.kwarg) if each is not None]
    return len(names) - (bool(names) and names[0] in ("self", "cls"))


def body(function: Function) -> int:
    """Lines of a function's body, without its docstring."""
    rest = function.body[1:] if ast.get_docstring(function) is not None else function.body
    return (rest[-1].end_lineno or 0) - rest[0].lineno + 1 if rest else 0


def compiled(function: Function) -> bool:
    """True for what numba compiles."""
    words = (ast.unparse(each) for each in function.decorator_list)
    return any(KERNEL in word or "njit" in word for word in words)


def by_place(function: Function) -> Iterator[ast.AST]:
    """Where a compiled function takes an argument apart by place instead of by name."""
    own = {each.arg for each in function.args.args}
    for node in ast.walk(function):
        if isinstance(node, ast.Assign):
            value, target = node.value, node.targets[0]
            while isinstance(value, ast.Subscript | ast.Attribute):
                if isinstance(value, ast.Subscript):
                    break
                value = value.value
            whole = isinstance(value, ast.Name) and value.id in own
            if whole and isinstance(target, ast.Tuple) and len(target.elts) >= MANY:
                yield node
        if isinstance(node, ast.Subscript) and isinstance(node.value, ast.Name):
            index = node.slice
            number = index.value if isinstance(index, ast.Constant) else None
            if node.value.id in own and isinstance(number, int) and number >= 2 * MANY:
                yield node


def figures(folder: Path) -> tuple[dict[str, int], dict[str, list[str]]]:
    """The figures of a package, and the places they come from.

    Args:
        folder: of the package.

    Returns:
        `modules` (without `__init__`), `lines`, `single_importers`, `circles`, `max_arguments`
        (commands' aside, whose arguments are a user's options), `max_body` [lines],
        `duplicate_class_names`, `positional_unpacks` in compiled functions, `what_docstrings`;
        and the worst or all places of each.
    """
    modules, places = read(folder), Places()
    known = {module.name: module for module in modules}
    edges = {module.name: imports(module, known) for module in modules}
    importers = Counter(other for names in edges.values() for other in names)
    for module in modules:
        if importers[module.name] == 1 and not module.package:
            places.add("single_importers", module, module.tree, module.name)
    rings = circles(edges)
    places.found["circles"] = [" - ".join(ring) for ring in rings]
    worst = _functions(modules, places)
    _classes(modules, places)
    count = {name: len(places.found[name]) for name in (
        "single_importers", "circles", "duplicate_class_names", "positional_unpacks",
        "what_docstrings",
    )}  # fmt: skip
    size = {
        "modules": sum(not module.package for module in modules),
        "lines": sum(module.lines for module in modules),
    }
    return {**size, **count, **worst}, dict(places.found)


def _functions(modules: list[Module], places: Places) -> dict[str, int]:
    worst = {"max_arguments": 0, "max_body": 0}
    for module in modules:
        for function in functions(module):
            commands = ".commands." in module.name or module.name.endswith(".command")
            for figure, size in (
                ("max_arguments", 0 if commands else arguments(function)),
                ("max_body", body(function)),
            ):
                places.add(figure, module, function, f"{function.name} {size}")
                worst[figure] = max(worst[figure], size)
            if compiled(function):
                for node in by_place(function):
                    places.add("positional_unpacks", module, node, ast.unparse(node)[:60])
    for figure in worst:
        places.found[figure].sort(key=lambda place: -int(place.rpartition(" ")[2]))
        del places.found[figure][20:]
    return worst


def _classes(modules: list[Module], places: Places) -> None:
    homes = defaultdict(list)
    for module in modules:
        for node in ast.walk(module.tree):
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                homes[node.name].append(module.name)
            if isinstance(node, ast.ClassDef | Function | ast.Module):
                told = (ast.get_docstring(node) or "").split(maxsplit=1)
                if told and told[0].strip(",.:") in INDIRECT:
                    name = getattr(node, "name", module.name)
                    places.add("what_docstrings", module, node, name)
    places.found["duplicate_class_names"] = [
        f"{name}: {', '.join(where)}" for name, where in sorted(homes.items()) if len(where) > 1
    ]
