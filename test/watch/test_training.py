from __future__ import annotations

from contextlib import closing

import numpy as np
import pytest
from browser import until
from robots import direct_model, field

from nics_drl_bridge.env.vector_env import BridgeVectorEnv
from nics_drl_bridge.watch.server import PageServer
from nics_drl_bridge.watch.training import TrainingView
from watch.rig import Client


class Envs:
    def __init__(self, *counts):
        model = direct_model()
        self.envs = tuple(
            BridgeVectorEnv(count, model, field(count=k), autoreset_mode="SameStep")
            for k, count in enumerate(counts)
        )
        for env in self.envs:
            env.reset(seed=0)

    def step(self):
        for env in self.envs:
            env.step(np.full((env.num_envs, 3), 0.2, np.float32))


@pytest.fixture
def server():
    with closing(PageServer(port=0)) as running:
        yield running


def test_some_worlds_of_each_env_are_shown_while_a_page_is_open(server):
    envs = Envs(20, 3)
    view = TrainingView(server, envs)
    view.note = "success 12.0 %"
    with closing(Client(server)) as client:
        stage = client.next("stage")
        assert len(stage["places"]) == 2
        assert stage["can"] == []
        until(lambda: server.watched, "the page")
        envs.step()
        view()
        frame = client.next("frame")
    assert frame["note"] == "success 12.0 %"
    assert [world["place"] for world in frame["worlds"]] == [0] * 4 + [1] * 3
    for n, world in enumerate(frame["worlds"][:4]):
        pose = envs.envs[0].simulator.data.pose[n, 0]
        assert world["poses"][0] == pytest.approx(1000 * pose, abs=1)


def test_frames_are_far_apart_and_none_is_drawn_while_nobody_looks(server, monkeypatch):
    envs = Envs(2)
    sent = []
    view = TrainingView(server, envs)
    with monkeypatch.context() as nobody:
        nobody.setattr(envs.envs[0], "snapshot", lambda _: pytest.fail("nobody looks"))
        envs.step()
        view()
    clock = [10.0]
    monkeypatch.setattr(
        "nics_drl_bridge.watch.training.time.monotonic", lambda: clock[0]
    )
    monkeypatch.setattr(server, "publish", sent.append)
    with closing(Client(server)):
        until(lambda: server.watched, "the page")
        for _ in range(10):
            envs.step()
            view()
            clock[0] += 0.03
    assert len(sent) == 2
    assert len(sent[-1].worlds[0].trails[0]) == 7  # its way has each step, though
