"""Checks of what callers pass to public functions: one sentence for each mistake.

A robot and the model of it are one thing to a caller, so `robot=` and `model=` are one keyword.
"""

import math
import reprlib
from collections.abc import Callable, Iterable, Mapping
from functools import wraps
from inspect import Parameter, signature
from os import PathLike
from typing import Any, ParamSpec, TypeVar

from nics_drl_bridge.errors import ConfigError, suggest

P = ParamSpec("P")
T = TypeVar("T")
ROBOT_WORDS = ("robot", "model")
LARGEST_COUNT = 2**31 - 1
KINDS: dict[
    str, tuple[tuple[type, ...], str]
] = {  # annotation -> types, name in errors
    "bool": ((bool,), "True or False"),
    "int": ((int,), "a whole number"),
    "float": ((int, float), "a finite number"),
}
_SHORT = reprlib.Repr()
_SHORT.maxstring = 80
_SHORT.maxother = 80


def to_plain(value: Any) -> Any:
    """Returns the number of a numpy scalar, and other values as they are; it loads no numpy."""
    return value.item() if getattr(value, "shape", None) == () else value


def format_value(value: Any) -> str:
    """Returns a value as a message quotes it: a number or text itself, else its type."""
    value = to_plain(value)
    if value is None or isinstance(value, str | bool | int | float | PathLike):
        return _SHORT.repr(value)
    if isinstance(value, list | tuple | dict | set) and len(value) == 0:
        return repr(value)
    return f"of type {type(value).__name__}"


def check_kind(what: str, value: Any, annotation: Any) -> None:
    """Raises ConfigError if a value is not of an annotation bool, int or float, maybe `| None`.

    Other annotations are not checked. A bool is no number, and a number is finite.
    """
    kind, optional, _ = str(getattr(annotation, "__name__", annotation)).partition(
        " | None"
    )
    if kind not in KINDS or (optional and value is None):
        return
    types, name = KINDS[kind]
    number = to_plain(value)
    fits = kind == "bool" if isinstance(number, bool) else isinstance(number, types)
    if fits and isinstance(number, float):
        fits = math.isfinite(number)
    if not fits:
        needed = f"{name}, or None" if optional else name
        raise ConfigError(f"{what}={format_value(value)}: must be {needed}.")


def check_count(what: str, value: Any) -> None:
    """Raises ConfigError unless a value is a whole number of at least 1."""
    check_kind(what, value, int)
    if not 1 <= value <= LARGEST_COUNT:
        raise ConfigError(
            f"{what}={format_value(value)}: must be a whole number of at least 1."
        )


def check_options(what: str, value: Any) -> None:
    """Raises ConfigError unless a value is a dictionary whose keys are names, or None."""
    if value is not None and not isinstance(value, Mapping):
        raise ConfigError(
            f"{what}={format_value(value)}: must be a dict of options by name, or None."
        )
    for name in value or ():
        if not isinstance(name, str):
            raise ConfigError(
                f"{what}: the key {format_value(name)} must be the name of an option."
            )


def check_path(what: str, value: Any) -> None:
    """Raises ConfigError unless a value is a path: text, or an object that stands for one."""
    if not isinstance(value, str | PathLike):
        raise ConfigError(f"{what}={format_value(value)}: must be a name or a path.")
    if "\0" in str(value):
        raise ConfigError(
            f"{what}={format_value(value)}: a path holds no null character."
        )


def list_keywords(function: Callable[..., Any]) -> set[str]:
    """Returns the names of a function's arguments, without `self` and `**others`."""
    several = (Parameter.VAR_KEYWORD, Parameter.VAR_POSITIONAL)
    known = signature(function).parameters.values()
    return {each.name for each in known if each.kind not in several} - {"self"}


def refuse_unknown(place: str, given: Iterable[str], known: Iterable[str]) -> None:
    """Raises ConfigError for the first keyword that is not known, with the nearest one."""
    valid = set(known)
    for name in given:
        if name not in valid:
            hint = suggest(name, valid)
            raise ConfigError(f"{place}: unknown argument {name!r}; {hint}")


def rename_robot_argument(
    place: str, own: str, named: dict[str, Any], positional: Any = None
) -> None:
    """Renames the argument `robot` or `model`, in place, to a function's own word for it.

    `positional` is the value of its own that was given without a name. Raises ConfigError for two
    different ones.
    """
    (other,) = set(ROBOT_WORDS) - {own}
    if other not in named:
        return
    value = named.pop(other)
    first = named.get(own, positional)
    if value is None:
        return
    if first is not None and not _is_same(first, value):
        both = f"{own}={format_value(first)} and {other}={format_value(value)}"
        raise ConfigError(
            f"{place}: {both} name two robots by two words for one thing; give one."
        )
    if positional is None:
        named[own] = value


def _is_same(one: Any, other: Any) -> bool:
    return one is other or (isinstance(one, str | PathLike) and str(one) == str(other))


def check_arguments(
    place: str, passes_to: Callable[..., Any] | None = None, without: Iterable[str] = ()
) -> Callable[[Callable[P, T]], Callable[P, T]]:
    """Makes a function, called `place` in messages, refuse arguments that it can't mean.

    It accepts `robot=` and `model=` alike if it has either. An unknown keyword, and a value that is
    not of an annotated bool, int or float, is a ConfigError. `passes_to` gets its `**others`, but
    for those in `without`, which the function gives itself.
    """

    def decorate(function: Callable[P, T]) -> Callable[P, T]:
        parameters = signature(function).parameters
        order = list(parameters)
        own = next((word for word in ROBOT_WORDS if word in parameters), None)
        known = list_keywords(function)
        annotations = {name: each.annotation for name, each in parameters.items()}
        if passes_to is not None:
            further = signature(passes_to).parameters
            known |= list_keywords(passes_to) - set(without)
            annotations = {
                name: each.annotation for name, each in further.items()
            } | annotations

        @wraps(function)
        def call(*args: P.args, **kwargs: P.kwargs) -> T:
            named: dict[str, Any] = dict(kwargs)
            given = dict(zip(order, args, strict=False))
            if own is not None:
                rename_robot_argument(place, own, named, given.get(own))
            refuse_unknown(place, named, known)
            for name, value in {**given, **named}.items():
                check_kind(f"{place}: {name}", value, annotations[name])
            return function(*args, **named)

        return call

    return decorate
