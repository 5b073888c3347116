"""Entry point of `nics`: reports a missing or outdated library in one sentence."""

import atexit
import contextlib
import os
import signal
import sys
from typing import NoReturn

from nics_drl_bridge.commands.interrupts import (
    has_heard_ctrl_c,
    take_signals,
    was_interrupted,
)
from nics_drl_bridge.exit_codes import EXIT_BAD_INPUT, EXIT_INTERRUPTED
from nics_drl_bridge.nodes.transport import set_transport


def main() -> None:
    """Runs a command; everything it needs is imported only now."""
    take_signals()
    set_transport(os.environ)
    try:
        _run()
    except SystemExit as end:
        # With code 0 the command has handled the interrupt.
        if has_heard_ctrl_c() and end.code not in (0, None):
            _leave_interrupted()
        raise


def _run() -> None:
    try:
        from nics_drl_bridge.commands.cli import main as run

        run()
    except SystemExit:
        raise
    except BaseException as error:  # noqa: BLE001  (_explain raises what it can't explain)
        _explain(error)


def _leave_interrupted() -> NoReturn:
    """Ends the process with the exit code of an interrupt, whatever the pending error.

    Otherwise Python ends by the signal if Ctrl-C came inside `exec` (dataclasses use it), and with
    other exit codes if libraries shut down while their threads still run.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # ignore further Ctrl-C
    with contextlib.suppress(Exception):
        atexit._run_exitfuncs()  # sends zero commands, removes files, ends processes
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(Exception):  # the reader is gone
            stream.flush()
    os._exit(EXIT_INTERRUPTED)


def _explain(error: BaseException) -> NoReturn:
    """Exits with a sentence about an error outside of any command, or raises the error."""
    if was_interrupted(error):
        sys.stderr.write("nics: interrupted; nothing was started.\n")
        raise SystemExit(EXIT_INTERRUPTED) from None
    if isinstance(error, ImportError):
        from nics_drl_bridge import extensions

        clause = extensions.explain_unmet(error)
        if clause is None:
            raise error
        sys.stderr.write(f"nics: {clause}\n")
        raise SystemExit(EXIT_BAD_INPUT) from None
    from nics_drl_bridge.errors import BridgeError

    if isinstance(error, BridgeError):  # a module refuses to be imported
        sys.stderr.write(f"nics: {error}\n")
        raise SystemExit(EXIT_BAD_INPUT) from None
    raise error


if __name__ == "__main__":
    main()
