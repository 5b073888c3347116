"""Filters of entities by a regular expression of their names."""

import re

# A search takes time in the power of the repetitions, and exponential time where one is repeated.
MOST_REPETITIONS = 3
REPETITION = re.compile(r"(?<!\\)[*+{]")
REPEATED_GROUP = re.compile(r"(?<!\\)\)[*+{]")


def compile_filter(text: str) -> re.Pattern[str]:
    """Compiles a filter. Raises ValueError for one that can't be read, or may search for hours."""
    repetitions = len(REPETITION.findall(text))
    if repetitions > MOST_REPETITIONS or REPEATED_GROUP.search(text):
        raise ValueError(
            f"the filter {text!r} may take hours; repeat no group, and use at most "
            f"{MOST_REPETITIONS} repetitions."
        )
    try:
        return re.compile(text)
    except re.error as error:
        reason = f"is no regular expression ({error}); mend it."
        raise ValueError(f"the filter {text!r} {reason}") from None
