"""The process of a node: its output, which never blocks it, and its end, which is never slow.

ROS 2, its libraries and Python write to the file descriptors 1 and 2. A terminal halted by Ctrl-S,
or a pipe that nobody reads, would block them. So both descriptors lead into a non-blocking pipe,
whose content `tee` forwards to the output and to the log file; what does not fit is dropped. The
terminal itself must not be made non-blocking, because that would affect every process that uses it.

Python runs signal handlers between two of its own instructions, so none runs while LLVM compiles
for seconds. Until a node spins, it has nothing to clean up, and signals keep their default effect:
they end the process, with the signal's exit code. At the end, Python is not finalised either: on a
busy machine that takes as long as everything before, and unloads libraries while their threads run.
"""

import contextlib
import fcntl
import io
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from typing import Any, NoReturn, TextIO

STDOUT = 1
STDERR = 2
PIPE_BYTES = 2**20  # Linux's maximum for an unprivileged process
FINISH_S = 1.0  # time for writing the last lines [s]

DISABLE_FILES = ["--ros-args", "--disable-external-lib-logs"]
FILE_CHOICES = (
    "--disable-external-lib-logs",
    "--enable-external-lib-logs",
    "--log-file-name",
)

REFUSED = (
    "parameter 'priority': the system does not allow a real-time priority of {priority} ({error}); "
    "allow it by `ulimit -r {priority}`, `LimitRTPRIO={priority}` in its systemd unit or the "
    "capability CAP_SYS_NICE, or set 0. The gate runs without it."
)

Forwarder = subprocess.Popen[bytes]
_forwarders: list[Forwarder] = []  # of this process


class _DroppingFile(io.RawIOBase):
    """A file descriptor as Python's output; it drops what can't be written at once."""

    def __init__(self, descriptor: int) -> None:
        super().__init__()
        self._descriptor = descriptor

    def fileno(self) -> int:
        return self._descriptor

    def writable(self) -> bool:
        return True

    def write(self, data: bytes) -> int:  # type: ignore[override]
        with contextlib.suppress(OSError):  # the pipe is full, or its reader has ended
            os.write(self._descriptor, data)
        return len(data)


def list_log_arguments(words: Sequence[str]) -> list[str]:
    """Return ROS 2 arguments that turn off its log file, because `tee` writes one.

    ROS 2 writes it within a node's call, which a slow disk would block. If the user's words choose
    a log file themselves, it does.
    """
    if not _forwarders or any(word in FILE_CHOICES for word in words):
        return []
    return DISABLE_FILES


def name_log_file(node: str, words: Sequence[str]) -> str:
    """Return a node's log file, where ROS 2 would write it; empty if the words choose another."""
    if any(word in FILE_CHOICES for word in words):
        return ""
    home = os.environ.get("ROS_HOME") or os.path.join("~", ".ros")
    folder = os.environ.get("ROS_LOG_DIR") or os.path.join(home, "log")
    name = f"{node}_{os.getpid()}_{time.time_ns() // 1_000_000}.log"
    return os.path.abspath(os.path.join(os.path.expanduser(folder), name))


def forward_output(log: str = "") -> None:
    """Let `tee` write the output of this process, and to the file `log` if it is named.

    Call this before any thread exists.
    """
    if _forwarders:
        return
    if log:
        with contextlib.suppress(OSError):  # the output is forwarded all the same
            os.makedirs(os.path.dirname(log), exist_ok=True)
    descriptors = _list_outputs()
    _forwarders.extend(filter(None, [_forward(each, log) for each in descriptors]))
    if not _forwarders:
        return
    if STDOUT not in descriptors:
        os.dup2(STDERR, STDOUT)
    sys.stdout = _open_dropping(STDOUT)
    sys.stderr = _open_dropping(STDERR)


def finish_output(seconds: float) -> None:
    """Wait until all output is written, or for some time; nothing can be written after that."""
    if not _forwarders:
        return
    nowhere = os.open(os.devnull, os.O_WRONLY)
    for descriptor in (STDOUT, STDERR):
        os.dup2(nowhere, descriptor)
    deadline = time.monotonic() + seconds
    for forwarder in _forwarders:
        with contextlib.suppress(subprocess.TimeoutExpired):
            forwarder.wait(max(0.0, deadline - time.monotonic()))


@contextlib.contextmanager
def forward_errors() -> Iterator[None]:
    """Within this context, let `tee` write what this process writes to stderr.

    For a command that is not a node's own process but moves a robot, or records one: ROS 2 and this
    package log to stderr meanwhile. At the end, wait for a moment until all is written.
    """
    if _forwarders:
        yield
        return
    python_errors = sys.stderr
    direct = os.dup(STDERR)
    forwarder = _forward(STDERR)
    if forwarder is None:
        os.close(direct)
        yield
        return
    if _writes_to_stderr(python_errors):
        python_errors.flush()
        sys.stderr = _open_dropping(STDERR)
    try:
        yield
    finally:
        sys.stderr = python_errors
        os.dup2(direct, STDERR)
        os.close(direct)
        with contextlib.suppress(subprocess.TimeoutExpired):
            forwarder.wait(FINISH_S)


def _writes_to_stderr(stream: TextIO) -> bool:
    try:
        return stream.fileno() == STDERR
    except (OSError, ValueError):  # a stream without a descriptor, or closed
        return False


def _open_dropping(descriptor: int) -> TextIO:
    file: Any = _DroppingFile(descriptor)
    return io.TextIOWrapper(file, "utf-8", "backslashreplace", write_through=True)


def _list_outputs() -> list[int]:
    """Return the outputs' descriptors; only one if both are the same, so that order is kept."""
    for descriptor in (0, STDOUT, STDERR):
        try:
            os.fstat(descriptor)
        except OSError:  # closed already; a pipe must not take its number
            os.open(os.devnull, os.O_RDWR)
    if os.path.samestat(os.fstat(STDOUT), os.fstat(STDERR)):
        return [STDERR]
    return [STDERR, STDOUT]


def _forward(descriptor: int, log: str = "") -> Forwarder | None:
    """Replace an output by a pipe to `tee`, which writes to it and to a file, if one is named.

    Returns None if `tee` can't be started.
    """
    exit_, entrance = os.pipe()
    try:
        forwarder = subprocess.Popen(
            ["tee", "-a", *([log] if log else [])],
            stdin=exit_,
            stdout=descriptor,
            stderr=subprocess.DEVNULL,
            start_new_session=True,  # neither Ctrl-C nor Ctrl-Z of the terminal reaches it
            restore_signals=False,  # it goes on with the file if the output's reader has gone
        )
        widen_pipe(entrance)
        os.dup2(entrance, descriptor)
        return forwarder
    except OSError as error:
        reason = f"output is written directly, and may block ({error.strerror})"
        sys.stderr.write(f"{reason}\n")
        return None
    finally:
        os.close(exit_)
        os.close(entrance)


def widen_pipe(entrance: int) -> None:
    """Let the entrance of a pipe hold as much as possible, and never block its writer."""
    os.set_blocking(entrance, False)
    # not available on every system; the default size will do
    with contextlib.suppress(AttributeError, OSError):
        fcntl.fcntl(entrance, fcntl.F_SETPIPE_SZ, PIPE_BYTES)


ENDING = (
    signal.SIGHUP,  # the terminal or the ssh session is gone
    signal.SIGINT,
    signal.SIGQUIT,
    signal.SIGUSR1,
    signal.SIGUSR2,
    signal.SIGALRM,
    signal.SIGTERM,
    signal.SIGVTALRM,
    signal.SIGPROF,
    signal.SIGXCPU,
    signal.SIGIO,
    signal.SIGPWR,
    *range(signal.SIGRTMIN, signal.SIGRTMAX + 1),
)
"""Signals that end a process unless it handles them, except SIGKILL, signals of a fault in the
process itself, and those that Python ignores, such as SIGPIPE."""


def leave(code: int) -> NoReturn:
    """End the process; call it when all is closed."""
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(Exception):  # whoever read it has gone
            stream.flush()
    finish_output(FINISH_S)
    os._exit(code)


def list_ending_signals() -> list[int]:
    """Return the signals at which this process ends cleanly.

    SIGHUP is not among them if the process is to outlive its terminal, as under `nohup`.
    """
    outlives = signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    return [number for number in ENDING if not (outlives and number == signal.SIGHUP)]


def take_priority(priority: int) -> str:
    """Give all present threads SCHED_FIFO, unless 0; return reason and fix if refused, or ""."""
    if priority == 0:
        return ""
    try:
        for thread in ("0", *os.listdir("/proc/self/task")):
            with contextlib.suppress(
                ProcessLookupError
            ):  # the thread has ended meanwhile
                # the writers of black boxes run at ordinary priority
                policy = os.SCHED_FIFO | os.SCHED_RESET_ON_FORK
                os.sched_setscheduler(int(thread), policy, os.sched_param(priority))
    except (
        OSError,
        AttributeError,
    ) as error:  # AttributeError: the system has no scheduler calls
        reason = str(getattr(error, "strerror", None) or "it has none").lower()
        return REFUSED.format(priority=priority, error=reason)
    return ""
