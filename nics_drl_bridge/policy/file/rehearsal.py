"""Opens a policy's network first in a separate process with limited memory and time.

The cost of parsing a graph, inferring its shapes and preparing it can't be predicted: a few
hundred kilobytes can request gigabytes. Foreign content is therefore opened in another
process first, where it can do no harm. Checked files are remembered by content, so each
costs a fraction of a second once per process.
"""

import json
import math
import os
import subprocess
import sys

from nics_drl_bridge.errors import PolicyError
from nics_drl_bridge.files import hash_bytes
from nics_drl_bridge.policy.file.onnx_session import check_network

MEMORY = 512 * 2**20  # limit, in addition to what the libraries use [bytes]
# additional limit per byte of the file: a network is in memory several times
MEMORY_OF_SIZE = 8
CPU_S = 10  # limit of CPU time; a network of 32 MB needs a tenth of it
WALL_S = 60.0  # limit of wall time, generous for a busy machine
MOST_REMEMBERED = 10_000
EXIT_MEMORY = 3
_CODE = "import sys; sys.path[:] = {path!r}; import {module} as one; one.main()"
# digests of content that opened without a fault, oldest first
_remembered: dict[str, None] = {}


def rehearse(data: bytes, source: str, runs: bool = True) -> None:
    """Runs `onnx_session.check_network` in another process. Raises PolicyError."""
    digest = _hash_request(data, runs)
    if digest in _remembered:
        return
    refusal = _answer_of(json.dumps(runs).encode() + b"\n" + data)
    if refusal is not None:
        raise PolicyError(source, *refusal)
    _remember(digest)


def remember(data: bytes) -> None:
    """Marks a policy file as checked: this process made its graph, or checked its parts."""
    _remember(_hash_request(data, runs=True))


def _hash_request(data: bytes, runs: bool) -> str:
    return hash_bytes(bytes([runs]) + data)


def _remember(digest: str) -> None:
    _remembered[digest] = None
    if len(_remembered) > MOST_REMEMBERED:
        del _remembered[next(iter(_remembered))]


def _answer_of(request: bytes) -> tuple[str, str] | None:
    """Returns the faulty field and the reason if the other process refuses a request, else None."""
    # Pass on the import path: `python -c` would also look in the working folder.
    code = _CODE.format(path=sys.path, module=__name__)
    single = dict.fromkeys(
        ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1"
    )
    try:
        done = subprocess.run(
            [sys.executable, "-c", code],
            input=request,
            capture_output=True,
            timeout=WALL_S,
            env=os.environ | single,
            check=False,
        )
    except subprocess.TimeoutExpired:
        return "graph", f"takes more than {WALL_S:.0f} s to open; not opened."
    except OSError as error:
        return "file", f"no process can be started to open it first ({error.strerror})."
    if done.returncode == 0:
        answer = json.loads(done.stdout)
        return None if answer is None else (str(answer[0]), str(answer[1]))
    # A negative code means ended by a signal: out of time, or crashed.
    if done.returncode == EXIT_MEMORY or done.returncode < 0:
        most = f"{MEMORY // 2**20} MB of memory or {CPU_S} s"
        return (
            "graph",
            f"takes more than {most} to open, and no policy does; not opened.",
        )
    last = (done.stderr.decode(errors="replace").strip().splitlines() or ["no output"])[
        -1
    ]
    return "file", f"the process that opens it first failed ({last}); not opened."


# The rest runs in the other process.


def main() -> None:
    """Handles the request on standard input within the limits; prints the fault, or null."""
    import onnxruntime  # noqa: F401 - before the limits, so that libraries don't count

    request = sys.stdin.buffer.read()
    head, _, data = request.partition(b"\n")
    del request
    _limit(MEMORY + MEMORY_OF_SIZE * len(data))
    answer = None
    try:
        check_network(data, "policy", json.loads(head))
    except Exception as error:
        if _is_of_memory(error):
            os._exit(EXIT_MEMORY)
        if not isinstance(error, PolicyError):
            raise
        answer = error.field, error.reason
    sys.stdout.write(json.dumps(answer))
    sys.stdout.flush()
    os._exit(0)  # skip the slow and needless teardown of the session


def _limit(memory: int) -> None:
    """Limits this process's resources; if the system can't, only the wall-time limit applies."""
    try:
        import resource
    except ImportError:  # Windows
        return
    used = resource.getrusage(resource.RUSAGE_SELF)
    cpu_s = math.ceil(used.ru_utime + used.ru_stime) + CPU_S
    resource.setrlimit(resource.RLIMIT_CPU, (cpu_s, cpu_s))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    if sys.platform == "linux":  # other systems ignore it
        with open("/proc/self/statm", encoding="ascii") as file:
            pages = int(file.read().split()[0])
        most = pages * resource.getpagesize() + memory
        resource.setrlimit(resource.RLIMIT_AS, (most, most))


def _is_of_memory(error: BaseException | None) -> bool:
    while error is not None:
        if isinstance(error, MemoryError):
            return True
        error = error.__cause__ or error.__context__
    return False
