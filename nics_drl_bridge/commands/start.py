"""Entry point of `nics`: one sentence, not a traceback, where a library is missing or too old."""

import sys

EXIT_BAD_INPUT, EXIT_INTERRUPTED = 2, 130


def main() -> None:
    """Runs a command, which imports what it needs as it runs."""
    try:
        from nics_drl_bridge.commands.cli import main as run

        run()
    except ImportError as error:
        from nics_drl_bridge import extensions

        if (clause := extensions.unmet(error)) is None:
            raise
        sys.stderr.write(f"nics: {clause}\n")
        raise SystemExit(EXIT_BAD_INPUT) from None
    except RuntimeError as error:
        if "no locator available" not in str(error):  # numba's, as kernels are imported
            raise
        reason = "neither the package's folder nor your home can be written to, to keep kernels in"
        sys.stderr.write(f"nics: {reason}; set NUMBA_CACHE_DIR to a folder that can.\n")
        raise SystemExit(EXIT_BAD_INPUT) from None
    except KeyboardInterrupt:  # before a command has begun
        sys.stderr.write("nics: interrupted; nothing was started.\n")
        raise SystemExit(EXIT_INTERRUPTED) from None


if __name__ == "__main__":
    main()
