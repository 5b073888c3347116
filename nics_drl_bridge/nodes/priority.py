"""Real-time priority of a process, where the system allows it."""

from __future__ import annotations

import contextlib
import os

HIGHEST = 99
REFUSED = (
    "parameter 'priority': the system does not allow a real-time priority of {priority} ({error}); "
    "allow it by `ulimit -r {priority}`, `LimitRTPRIO={priority}` in its systemd unit or the "
    "capability CAP_SYS_NICE, or set 0. It goes on without."
)


def take_priority(priority: int) -> str:
    """Lets all threads of this process go before every ordinary one (SCHED_FIFO).

    The threads of the middleware too: a gate that waits for them gains nothing by its own. Those
    that are made later have the priority of the thread that makes them.

    Args:
        priority: 1 to 99; 0 leaves everything as it is.

    Returns:
        A sentence that says why not, with the fix; empty when all is well.
    """
    if priority == 0:
        return ""
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
        for thread in os.listdir("/proc/self/task"):
            with contextlib.suppress(ProcessLookupError):  # it has ended meanwhile
                os.sched_setscheduler(int(thread), os.SCHED_FIFO, os.sched_param(priority))
    except (OSError, AttributeError) as error:  # the latter where there is no such thing
        reason = str(getattr(error, "strerror", None) or "it has none").lower()
        return REFUSED.format(priority=priority, error=reason)
    return ""
