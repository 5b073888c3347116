"""Entry point of `nics`: one sentence, not a traceback, where a library is missing or too old."""

import sys

from nics_drl_bridge import extensions

EXIT_BAD_INPUT = 2


def main() -> None:
    """Runs a command, which imports what it needs as it runs."""
    try:
        from nics_drl_bridge.commands.cli import main as run

        run()
    except ImportError as error:
        if (clause := extensions.unmet(error)) is None:
            raise
        sys.stderr.write(f"nics: {clause}\n")
        raise SystemExit(EXIT_BAD_INPUT) from None


if __name__ == "__main__":
    main()
