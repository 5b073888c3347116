from __future__ import annotations

import re
from contextlib import closing

import numpy as np
from robots import direct_model, field

from nics_drl_bridge.env.bridge_env import BridgeEnv
from watch.rig import Client


def test_render_mode_human_tells_where_its_page_is_and_shows_each_step(
    monkeypatch, capsys
):
    monkeypatch.setattr("nics_drl_bridge.watch.show.os.environ", {})
    env = BridgeEnv(model=direct_model(), world=field(count=2), render_mode="human")
    with closing(env):
        env.reset(seed=0, options={"start": (0.0, 0.0, 0.0)})
        told = capsys.readouterr().err
        assert re.fullmatch(r"watch: http://127\.0\.0\.1:\d+/\n", told)
        server = env._picture._server
        with closing(Client(server)) as client:
            client.next("stage", lambda stage: len(stage["places"]) == 1)
            env.step(np.array([1.0, 0.0, 0.0], np.float32))
            frame = client.next(
                "frame", lambda frame: len(frame["worlds"][0]["trails"][0]) == 2
            )
            assert frame["worlds"][0]["poses"][0][0] > 150
            env.reset(seed=1)
            client.next(
                "frame", lambda frame: len(frame["worlds"][0]["trails"][0]) == 1
            )
