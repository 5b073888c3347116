"""Frozen records, changed in some fields."""

from __future__ import annotations

from typing import Any, TypeVar

Record = TypeVar("Record")


def replace(record: Record, **changes: Any) -> Record:
    """A frozen record with other values in some fields, as `dataclasses.replace` makes it.

    That one goes through all fields in Python, for a state of thirty several times a decision. The
    record must have no `__post_init__` and no slots.

    Args:
        record: that stays as it is.
        changes: field -> its other value.

    Raises:
        TypeError: there is no such field.
    """
    held = vars(record)
    if not changes.keys() <= held.keys():
        raise TypeError(f"{type(record).__name__} has no {sorted(changes.keys() - held.keys())}")
    made = object.__new__(type(record))
    vars(made).update(held, **changes)
    return made
