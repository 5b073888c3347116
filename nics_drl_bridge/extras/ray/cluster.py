"""Connection to the Ray cluster for training: a running one, or one on this machine alone."""

from __future__ import annotations

import logging
import os
import socket
from collections.abc import Iterator
from contextlib import contextmanager

import ray

from nics_drl_bridge.errors import ConfigError

LOCAL, AUTO = "local", "auto"
TRIED_S = 5.0
"""Timeout of an attempt to connect to an address [s]."""


@contextmanager
def connected(address: str | None, runners: int | None, worlds: int) -> Iterator[int]:
    """Connects this process to a cluster, and yields the number of env runners.

    Args:
        address: `auto` (the cluster that this machine is part of) or `HOST:PORT`; None starts one
            on this machine, which ends with the training.
        runners: env runners; by default one for each CPU of the cluster.
        worlds: number of worlds that they share.

    Raises:
        ConfigError: no cluster answers there, or it is too small.
    """
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    # A lost worker is no error here, and Ray's messages about it would disturb the progress bar.
    os.environ.setdefault("RAY_BACKEND_LOG_LEVEL", "fatal")
    logging.getLogger("ray.rllib").setLevel(logging.CRITICAL)
    local = {"include_dashboard": False} if address is None else {}
    try:
        _check_listens(address)
        ray.init(address or LOCAL, log_to_driver=False, logging_level="ERROR", **local)
    except (OSError, OverflowError, ValueError, RuntimeError) as error:
        first = str(error).strip().partition("\n")[0].rstrip(".")
        raise ConfigError(
            f"--address {address}: no Ray cluster answers ({first}); start one on the first "
            "machine with 'ray start --head', and name the HOST:PORT that it prints."
        ) from None
    try:
        yield _runners(runners, int(ray.cluster_resources().get("CPU", 0)), worlds)
    finally:
        ray.shutdown()


def _check_listens(address: str | None) -> None:
    """Raises OSError if nothing listens at the address; Ray itself would try for minutes."""
    if address not in (None, AUTO):
        host, _, port = str(address).rpartition(":")
        socket.create_connection((host, int(port)), TRIED_S).close()


def _runners(runners: int | None, cpus: int, worlds: int) -> int:
    if runners is None:
        return max(1, min(cpus, worlds))
    if runners > cpus:
        raise ConfigError(
            f"--env-runners {runners}: the cluster has {cpus} CPUs, and each env runner takes one; "
            "add machines with 'ray start', or ask for fewer."
        )
    if runners > worlds:
        raise ConfigError(
            f"--env-runners {runners}: the settings have {worlds} worlds to share; give them more, "
            "or ask for fewer."
        )
    return runners
