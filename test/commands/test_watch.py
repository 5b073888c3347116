from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
from contextlib import closing, contextmanager
from types import SimpleNamespace

import pytest
import typer
from watch.rig import Client, source

from nics_drl_bridge.commands import console, train
from nics_drl_bridge.commands import watch as module


def test_a_page_without_its_library_is_refused_before_a_robot_is_opened(
    monkeypatch, capsys
):
    monkeypatch.setattr(
        module.extensions, "find_lacking", lambda names: next(iter(names))
    )
    monkeypatch.setattr(
        module, "_watch_episodes", lambda *given: pytest.fail("a robot was opened")
    )
    with pytest.raises(typer.Exit):
        console.check_options(module.watch)(policy="straight")
    assert "pip install 'nics_drl_bridge[view]'" in capsys.readouterr().err


@contextmanager
def serving(*words, cwd):
    """A command in a process of its own, once it says where its page is; and a client of it."""
    command = [sys.executable, "-m", "nics_drl_bridge.commands.cli", *words]
    environment = os.environ | {"DISPLAY": "", "WAYLAND_DISPLAY": ""}
    process = subprocess.Popen(
        command,
        cwd=cwd,
        env=environment,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        lines = iter(process.stderr.readline, "")
        place = next(
            filter(None, (re.match(r"watch: (http://\S+)", line) for line in lines)),
            None,
        )
        assert place is not None, "it ended without a page"
        with closing(Client(SimpleNamespace(url=place[1]))) as client:
            yield process, client
    finally:
        process.kill()
        process.stderr.close()
        process.wait()


@pytest.mark.process
def test_the_command_shows_a_policy_driving_until_ctrl_c(tmp_path):
    words = ("watch", "straight", "--world", "circles", "--port", "0")
    with serving(*words, cwd=tmp_path) as (process, client):
        assert "straight" in client.next("stage")["title"]
        first = client.next("frame")
        client.next("frame", lambda frame: frame != first)
        process.send_signal(signal.SIGINT)
        assert process.wait(30.0) == 130


def test_a_ctrl_c_that_compiled_code_swallowed_ends_it_all_the_same(monkeypatch):
    heard = []
    monkeypatch.setattr(module, "has_heard_ctrl_c", lambda: bool(heard))
    world = source()
    advance = world.advance
    monkeypatch.setattr(world, "advance", lambda: heard.append(True) or advance())
    with closing(world), pytest.raises(KeyboardInterrupt):
        module._serve(world, 0, False)
    assert len(heard) == 1


def test_a_watched_training_shows_each_env_and_what_it_does(monkeypatch):
    views = []

    def show(server, env):
        views.append(SimpleNamespace(env=env))
        return views[-1]

    def run(run, order, learn, as_json, note):
        learn()
        note("half of it")

    monkeypatch.setattr("nics_drl_bridge.watch.training.TrainingView", show)
    monkeypatch.setattr("nics_drl_bridge.watch.show.open_page", lambda url: None)
    monkeypatch.setattr(train, "_run", run)
    env = SimpleNamespace()
    train._run_watched(None, None, lambda on_worlds: on_worlds(env), False)
    assert env.on_step is views[0]
    assert views[0].env is env
    assert views[0].note == "half of it"


@pytest.mark.campaign
@pytest.mark.process
def test_a_training_shows_its_worlds(tmp_path):
    pytest.importorskip("tensorboard", reason="needs the extra train")
    words = ("train", "--world", "circles", "--steps", "200000", "--watch")
    with serving(*words, cwd=tmp_path) as (process, client):
        frame = client.next("frame", lambda frame: frame.get("worlds"))
        assert len(frame["worlds"]) > 1
        process.send_signal(signal.SIGINT)
        assert process.wait(60.0) == 130


def test_episodes_are_written_to_their_end(tmp_path, monkeypatch):
    written = []
    monkeypatch.setattr(
        "nics_drl_bridge.watch.record.write",
        lambda path, stage, frames, fps: written.extend([fps, *frames]),
    )
    with closing(source()) as made:
        module._record(tmp_path / "a.gif", made, 2)
    fps, *frames = written
    assert fps == 10.0
    assert {frame.worlds[0].name[-1] for frame in frames} == {"3", "4"}
    ends = {frame.worlds[0].state for frame in frames[-5:]}
    assert len(ends) == 1  # it stays for a second
    assert ends != {""}
