"""Errors that a user can cause and fix: one sentence that says what, where, and what to do."""

import difflib
from collections.abc import Iterable

# maximum length of a sentence [characters]; longer ones are cut in the middle
LONGEST = 800
LONGEST_NAME = 100  # characters of a name that are compared with the known names


def shorten(text: str, length: int) -> str:
    """Returns one printable line of about `length` characters, as messages quote user input."""
    if len(text) > length:
        text = f"{text[: length // 2]} ... {text[-(length // 2) :]}"
    text = " ".join(text.split())
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() else "?" for c in text)


class BridgeError(Exception):
    """Base of all errors caused by the user's input; one line of at most `LONGEST` characters."""

    def __init__(self, sentence: str = "") -> None:
        super().__init__(shorten(sentence, LONGEST))

    def reword(self, sentence: str) -> None:
        """Sets another sentence and keeps the fields of the error."""
        self.args = (shorten(sentence, LONGEST),)


class ConfigError(BridgeError):
    """A YAML file, key, name or option is wrong.

    Callers that report the error in another context read `key`, the key of a file, and `reason`,
    what is wrong, without the place. Both are "" where no caller needs them.
    """

    def __init__(self, sentence: str = "", *, key: str = "", reason: str = "") -> None:
        super().__init__(sentence)
        self.key = key
        self.reason = reason


class MissingFileError(ConfigError):
    """A file does not exist."""


class UnknownNameError(ConfigError):
    """A name does not match any file in `config/KIND`."""

    def __init__(self, sentence: str = "", kind: str = "") -> None:
        self.kind = kind
        super().__init__(sentence)


class RecordingError(BridgeError):
    """A recording can't be read or contains unusable data.

    `reason` is the part of the sentence that names the fault, for errors that quote it.
    """

    def __init__(self, sentence: str = "", reason: str = "") -> None:
        self.reason = reason
        super().__init__(sentence)


class ModelError(BridgeError):
    """A SimulatorModel can't be read, or does not fit what it is used with."""


class FitError(BridgeError):
    """A recording does not contain enough to fit a model."""


class BackendError(BridgeError):
    """A backend (simulator, ROS 2 graph, vehicle) does not respond correctly."""


class PolicyError(BridgeError):
    """A policy file can't be used, or does not fit the robot in a field such as `lidar.beams`."""

    def __init__(self, source: str, field: str, reason: str) -> None:
        self.source = source
        self.field = shorten(field, LONGEST_NAME)
        self.reason = shorten(reason, LONGEST // 2)
        super().__init__(f"{source}: field {self.field!r}: {self.reason}")

    def __reduce__(self) -> "tuple[type[PolicyError], tuple[str, str, str]]":
        """Lets the error be pickled."""
        return type(self), (self.source, self.field, self.reason)


class StaleDataError(BackendError):
    """No fresh data arrived on a topic in time; the age is `inf` if no message ever came."""

    def __init__(self, topic: str, age_s: float, limit_s: float) -> None:
        self.topic = topic
        self.age_s = age_s
        self.limit_s = limit_s
        never = age_s == float("inf")
        last = "nothing has ever arrived" if never else f"the last is {age_s:.3f} s old"
        super().__init__(
            f"topic {topic!r}: no fresh data within {limit_s:.3f} s, {last}; check that its "
            "publisher runs in this ROS domain and namespace."
        )

    def __reduce__(self) -> "tuple[type[StaleDataError], tuple[str, float, float]]":
        """Lets the error be pickled."""
        return type(self), (self.topic, self.age_s, self.limit_s)


def suggest(name: str, valid_names: Iterable[str]) -> str:
    """Returns a clause: `did you mean 'x'?`, or `valid are: 'x', 'y'` if none is close."""
    candidates = sorted(valid_names)
    close = difflib.get_close_matches(shorten(name, LONGEST_NAME), candidates, n=1)
    if close:
        return f"did you mean {close[0]!r}?"
    return "valid are: " + ", ".join(map(repr, candidates))
