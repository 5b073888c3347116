"""Exit codes of commands and nodes; imports nothing."""

from typing import Final

EXIT_BAD_INPUT: Final = 2
EXIT_INTERRUPTED: Final = 130  # by Ctrl-C: 128 + SIGINT
