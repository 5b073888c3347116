"""Names of columns: the words in them, and how a mapping writes them."""

import re


def word_set(text: str) -> frozenset[str]:
    """Returns the words of a text, split at white space."""
    return frozenset(text.split())


def split_words(name: str) -> list[str]:
    """Splits a name into its words: `vicon x`, `q.x`, `Left_Tick`, `cmdVel`."""
    parts = re.sub(r"([a-z])([A-Z])", r"\1 \2", name)
    return [word for word in re.split(r"[^A-Za-z]+", parts.lower()) if word]


def write_reference(reference: str) -> str:
    """Returns a reference as YAML that is also valid within a list."""
    plain = re.fullmatch(r"[A-Za-z/][\w/. -]*(:[\w. -]+)?|\d+", reference)
    is_word = reference.lower() not in ("true", "false", "null")
    return reference if plain and is_word else f'"{reference}"'
