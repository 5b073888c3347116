from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import threading
from contextlib import closing, contextmanager
from types import SimpleNamespace

import pytest
import typer
from browser import until
from command_line import nics
from watch.rig import Client, source

from nics_drl_bridge.commands import console
from nics_drl_bridge.commands import episodes as driving
from nics_drl_bridge.commands import watch as module
from nics_drl_bridge.commands.conditions import Conditions


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (
            ["--ros", "--bag", "drive"],
            "--bag does not go with --ros; leave out --bag, or --ros.",
        ),
        (["straight", "--bag", "drive"], "a policy does not go with --bag"),
        (["--ros", "--gate", "differential"], "--gate does not go with --ros"),
        (["--ros", "--record", "a.gif"], "--record does not go with --ros"),
        (
            ["straight", "--topic", "odom=/wheels"],
            "--topic: belongs to --bag; add that, or leave",
        ),
        (["straight", "--namespace", "ant"], "--namespace: belongs to --ros"),
        (["straight", "--episodes", "3"], "--episodes: belongs to --record"),
        (["--record", "a.avi"], "--record 'a.avi': "),
        (
            ["--bag", "nowhere", "--world", "arena", "--world", "room"],
            "a robot is in one",
        ),
        (["strait"], "did you mean 'straight'?"),
        (["straight", "--world", "areena"], "did you mean 'arena'?"),
    ],
)
def test_options_that_do_not_fit_are_one_sentence(options, said, tmp_path):
    done = nics("watch", *options, cwd=tmp_path)
    assert done.returncode == 2
    assert said in done.stderr
    assert done.stderr.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


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


def test_an_episode_has_the_time_that_its_policy_was_learnt_with(monkeypatch):
    learnt = SimpleNamespace(
        provenance={}, robot=SimpleNamespace(name="differential"), max_episode_steps=777
    )
    driven = []
    env_of = driving.open_env
    monkeypatch.setattr(
        driving, "read_contracts", lambda policies: dict.fromkeys(policies, learnt)
    )
    monkeypatch.setattr(
        driving,
        "open_env",
        lambda *given, **more: driven.append(given[4]) or env_of(*given, **more),
    )
    conditions = Conditions()
    with closing(module._watch_episodes("straight", None, ["circles"], 0, conditions)):
        assert [each.steps for each in driven] == [777]


def test_a_training_of_other_processes_can_not_be_watched(tmp_path):
    done = nics("train", "--watch", "--engine", "ray", cwd=tmp_path)
    assert done.returncode == 2
    assert (
        "--watch --engine ray: worlds of other processes are not shown" in done.stderr
    )


def test_an_episode_is_written_to_its_end(tmp_path, monkeypatch):
    written = []
    monkeypatch.setattr(
        "nics_drl_bridge.watch.record.write",
        lambda path, stage, frames, fps: written.extend([fps, *frames]),
    )
    with closing(source()) as made:
        module._record(tmp_path / "a.gif", made, 2)
    fps, *frames = written
    assert fps == 10.0
    names = [frame.worlds[0].name.rpartition(" ")[2] for frame in frames]
    assert set(names) == {"3", "4"}
    assert frames[-1].worlds[0].state
    assert (
        frames[-1].worlds[0].state == frames[-5].worlds[0].state
    )  # it stays for a second


def test_the_page_is_served_until_it_is_interrupted(monkeypatch):
    servers, seen = [], threading.Event()

    def show(made, server):
        servers.append(server)
        server.set_stage(made.stage())
        until(seen.is_set, "the page")

    monkeypatch.setattr("nics_drl_bridge.watch.show.show", show)
    with closing(source()) as made:
        serving = threading.Thread(target=module._serve, args=(made, 0, False))
        serving.start()
        with closing(Client(until(lambda: servers, "a server")[0])) as client:
            assert client.next("stage")["title"] == "forward in field"
            assert servers[0].watched
            seen.set()
        serving.join()
    assert servers[0].closed


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


@pytest.mark.process
@pytest.mark.slow
def test_a_training_shows_its_worlds(tmp_path):
    pytest.importorskip("torch", reason="needs the extra train")
    words = ("train", "--world", "circles", "--steps", "200000", "--watch")
    with serving(*words, cwd=tmp_path) as (process, client):
        frame = client.next("frame", lambda frame: frame.get("worlds"))
        assert len(frame["worlds"]) > 1
        process.send_signal(signal.SIGINT)
        assert process.wait(60.0) == 130
