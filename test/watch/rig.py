"""A source whose every frame is known, and a client of the page's socket."""

from __future__ import annotations

import json
import threading
import time
from contextlib import ExitStack, closing, contextmanager
from dataclasses import replace

import numpy as np
from browser import DEADLINE_S
from robots import direct_model, field

from nics_drl_bridge.env.bridge_env import BridgeEnv
from nics_drl_bridge.env.snapshot import Snapshot
from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.watch.episode import EpisodeSource
from nics_drl_bridge.watch.server import PageServer
from nics_drl_bridge.watch.show import show


def shot(**changes) -> Snapshot:
    """One robot at (1 m, 0 m), heading 90 degrees, amid 72 beams of 1 m; one disc."""
    pose = np.array([[1.0, 0.0, np.pi / 2]])
    body = np.array([[1.0, 1.5, 0.0, 1.0, 0.0, 0.25, 0.0]])
    known = Snapshot(pose, np.ones((1, 72), np.float32), body, np.array([[2.0, 0.5]]))
    return replace(known, **changes)


class Forward:
    """A policy that drives forward."""

    def act(self, observation):
        return np.array([1.0, 0.0, 0.0], np.float32)


def source(
    count: int = 2,
    seed: int = 3,
    model=None,
    world=None,
    worlds: int = 1,
    model_name: str = "",
) -> EpisodeSource:
    """Episodes of a robot that drives straight ahead among some discs, in a field of 6 m."""
    model = model or direct_model()

    def make(policy, world):
        env = BridgeEnv(model=model, world=world, estimator=True)
        if policy == "broken":
            raise ConfigError("policy 'broken': it does not open.")
        return env, Forward()

    places = [world or field(count=count)] * worlds
    return EpisodeSource(make, "forward", places, seed, model_name)


class Client:
    """A program that speaks to the page's socket."""

    def __init__(self, server: PageServer) -> None:
        from websockets.sync.client import connect

        address = f"{server.url.replace('http', 'ws')}socket"
        self._open = ExitStack()
        self.socket = self._open.enter_context(connect(address, max_size=None))

    def ask(self, kind: str, **about) -> None:
        self.socket.send(json.dumps({"kind": kind, **about}))

    def next(self, kind: str, fits=lambda message: True):
        """The next message of a kind that fits."""
        deadline = time.monotonic() + DEADLINE_S
        while True:
            message = json.loads(
                self.socket.recv(timeout=max(0.0, deadline - time.monotonic()))
            )
            if message["kind"] == kind and fits(message):
                return message

    def close(self) -> None:
        self._open.close()


@contextmanager
def shown(of):
    """A source on a page: the server, and a client that has opened it."""
    with closing(PageServer(port=0)) as server:
        thread = threading.Thread(target=show, args=(of, server), daemon=True)
        thread.start()
        with closing(Client(server)) as client:
            yield server, client
    thread.join(DEADLINE_S)
    assert not thread.is_alive()
