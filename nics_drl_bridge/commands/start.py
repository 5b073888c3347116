"""Entry point of `nics`: one sentence, not a traceback, where a library is missing or too old."""

import signal
import sys
import threading
from types import FrameType

EXIT_BAD_INPUT, EXIT_INTERRUPTED = 2, 130
ENDING = {signal.SIGINT: signal.default_int_handler, signal.SIGTERM: signal.SIG_DFL}


def _end(number: int, frame: FrameType | None) -> None:
    while frame is not None and not frame.f_code.co_name.startswith("_raw_object_cache"):
        frame = frame.f_back
    if frame is not None:  # llvmlite's callback, out of which no exception comes: a little later
        threading.Timer(0.01, signal.raise_signal, (number,)).start()
    elif number == signal.SIGINT:
        raise KeyboardInterrupt
    else:
        raise SystemExit(128 + number)


def main() -> None:
    """Runs a command, which imports what it needs as it runs."""
    for number, usual in ENDING.items():
        if signal.getsignal(number) is usual:  # else somebody wants it ignored
            signal.signal(number, _end)
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
