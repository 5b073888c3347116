"""Checks of arguments of public functions, with one sentence for each mistake.

Callers may write `robot=` or `model=`: both name the same argument.
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
# annotation -> types, name in errors
KINDS: dict[str, tuple[tuple[type, ...], str]] = {
    "bool": ((bool,), "True or False"),
    "int": ((int,), "a whole number"),
    "float": ((int, float), "a finite number"),
}
_SHORT = reprlib.Repr()
_SHORT.maxstring = 80
_SHORT.maxother = 80


def to_plain(value: Any) -> Any:
    """Converts a numpy scalar to a Python number, without loading numpy; keeps other values."""
    return value.item() if getattr(value, "shape", None) == () else value


def format_value(value: Any) -> str:
    """Formats a value for a message: numbers and text in full, otherwise its type."""
    value = to_plain(value)
    if value is None or isinstance(value, str | bool | int | float | PathLike):
        return _SHORT.repr(value)
    if isinstance(value, list | tuple | dict | set) and len(value) == 0:
        return repr(value)
    return f"of type {type(value).__name__}"


def check_kind(what: str, value: Any, annotation: Any) -> None:
    """Raises ConfigError unless a value fits its annotation: bool, int or float, or with `| None`.

    Other annotations are not checked. A bool is not a number, and numbers must be finite.
    """
    kind, optional, _ = str(getattr(annotation, "__name__", annotation)).partition(
        " | None"
    )
    if kind not in KINDS or (optional and value is None):
        return
    types, kind_name = KINDS[kind]
    scalar = to_plain(value)
    if isinstance(scalar, bool):
        fits = kind == "bool"
    else:
        fits = isinstance(scalar, types)
    if fits and isinstance(scalar, float):
        fits = math.isfinite(scalar)
    if not fits:
        needed = f"{kind_name}, or None" if optional else kind_name
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
    """Raises ConfigError unless a value is a path: a string or a path-like object."""
    if not isinstance(value, str | PathLike):
        raise ConfigError(f"{what}={format_value(value)}: must be a name or a path.")
    if "\0" in str(value):
        raise ConfigError(
            f"{what}={format_value(value)}: a path can't contain a null character."
        )


def list_keywords(function: Callable[..., Any]) -> set[str]:
    """Returns the names of a function's arguments, without `self` and `**others`."""
    several = (Parameter.VAR_KEYWORD, Parameter.VAR_POSITIONAL)
    parameters = signature(function).parameters.values()
    return {
        parameter.name for parameter in parameters if parameter.kind not in several
    } - {"self"}


def refuse_unknown(
    place: str, names: Iterable[str], valid_names: Iterable[str]
) -> None:
    """Raises ConfigError for the first unknown keyword, with the nearest valid name."""
    valid_set = set(valid_names)
    for name in names:
        if name not in valid_set:
            hint = suggest(name, valid_set)
            raise ConfigError(f"{place}: unknown argument {name!r}; {hint}")


def rename_robot_argument(
    place: str, word: str, named: dict[str, Any], positional: Any = None
) -> None:
    """Renames the argument `robot` or `model`, in place, to the name that a function uses.

    `positional` is the value that was passed without a name. Raises ConfigError if both arguments
    are passed with different values.
    """
    (synonym,) = set(ROBOT_WORDS) - {word}
    if synonym not in named:
        return
    value = named.pop(synonym)
    value_by_word = named.get(word, positional)
    if value is None:
        return
    is_same = value_by_word is value or (
        isinstance(value_by_word, str | PathLike) and str(value_by_word) == str(value)
    )
    if value_by_word is not None and not is_same:
        values = (
            f"{word}={format_value(value_by_word)} and {synonym}={format_value(value)}"
        )
        raise ConfigError(
            f"{place}: {values} name two robots, but the arguments are synonyms; give "
            "one."
        )
    if positional is None:
        named[word] = value


def check_arguments(
    place: str, passes_to: Callable[..., Any] | None = None, without: Iterable[str] = ()
) -> Callable[[Callable[P, T]], Callable[P, T]]:
    """Makes a function, called `place` in messages, refuse unknown and mistyped arguments.

    If it has `robot` or `model`, it accepts either name. An unknown keyword, or a value that does
    not fit an annotation of bool, int or float, raises ConfigError. The function passes its
    `**others` to `passes_to`, except for those in `without`, which it sets itself.
    """

    def decorate(function: Callable[P, T]) -> Callable[P, T]:
        parameters = signature(function).parameters
        order = list(parameters)
        robot_word = next((word for word in ROBOT_WORDS if word in parameters), None)
        names = list_keywords(function)
        annotations = {
            name: parameter.annotation for name, parameter in parameters.items()
        }
        if passes_to is not None:
            target = signature(passes_to).parameters
            names |= list_keywords(passes_to) - set(without)
            annotations = {
                name: parameter.annotation for name, parameter in target.items()
            } | annotations

        @wraps(function)
        def call(*args: P.args, **kwargs: P.kwargs) -> T:
            named: dict[str, Any] = dict(kwargs)
            positional = dict(zip(order, args, strict=False))
            if robot_word is not None:
                rename_robot_argument(
                    place, robot_word, named, positional.get(robot_word)
                )
            refuse_unknown(place, named, names)
            for name, value in {**positional, **named}.items():
                check_kind(f"{place}: {name}", value, annotations[name])
            return function(*args, **named)

        return call

    return decorate
