"""The names of `bench.py` for two campaigns."""

from bench import answer, parser_of

__all__ = ["answer", "parser_of"]
