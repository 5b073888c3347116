from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import closing, contextmanager
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
from browser import CHROMIUM, Browser, until
from domains import claimed_domain

from nics_drl_bridge.recording import textbook
from nics_drl_bridge.recording.recording import save_recording
from nics_drl_bridge.robot.spec import load_robot

DEADLINE_S = 300.0
campaign = pytest.mark.campaign
LAST_LINE = r"demo: in process ([01])/1, over DDS ([01])/1, report (.+/report\.html)"
READY_MADE = ("--policy", "differential")
DEVIATION = r"<td>([0-9.e+-]+)</td></tr>"


def needs_ros(test):
    """Marks a test that drives over ROS 2, and skips it where there is none."""
    reason = "needs ROS 2: rclpy is not installed"
    return pytest.mark.ros(
        pytest.mark.skipif(find_spec("rclpy") is None, reason=reason)(test)
    )


class Running:
    """A demo as a process, with the lines it printed so far."""

    def __init__(self, process: subprocess.Popen[str]) -> None:
        self.process = process
        self.lines = []
        self._changed = threading.Condition()
        threading.Thread(target=self._read, daemon=True).start()

    def _read(self) -> None:
        for line in self.process.stdout:
            with self._changed:
                self.lines.append(line.rstrip("\n"))
                self._changed.notify_all()

    def until(self, pattern: str) -> None:
        """Waits for a line that matches."""
        with self._changed:
            came = self._changed.wait_for(
                lambda: any(re.search(pattern, line) for line in self.lines), DEADLINE_S
            )
        assert came, f"no line {pattern!r}; {self.lines}"


@contextmanager
def demo(*words: object, cwd: Path) -> Iterator[Running]:
    with claimed_domain() as domain_id:
        process = subprocess.Popen(
            [
                sys.executable,
                "-m",
                "nics_drl_bridge.commands.cli",
                "demo",
                *map(str, words),
            ],
            cwd=cwd,
            env=os.environ | {"ROS_DOMAIN_ID": str(domain_id), "PYTHONUNBUFFERED": "1"},
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,
        )
        try:
            yield Running(process)
        finally:
            process.kill()
            process.wait()


def processes_below(folder: Path) -> list[str]:
    """Command lines of the processes that work with files in a folder."""
    found = []
    for entry in Path("/proc").iterdir():
        if entry.name.isdecimal():
            try:
                line = (entry / "cmdline").read_bytes().replace(b"\0", b" ").decode()
                at = os.readlink(entry / "cwd")
            except OSError:
                continue
            if line and at == str(folder):
                found.append(line)
    return found


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
    """Words for a short drive, of which a simulator is sooner generated than of the usual one."""
    robot = load_robot("differential")
    path = tmp_path_factory.mktemp("drive") / "drive.npz"
    save_recording(textbook.record(robot, np.random.default_rng(1), 20.0), path)
    return ("--robot", "differential", "--recording", path)


@needs_ros
@pytest.mark.process
@pytest.mark.slow
def test_it_goes_the_whole_road_and_leaves_a_report(tmp_path, drive):
    words = ("--episodes", 1, "--world", "empty", "--out", "out", *READY_MADE, *drive)
    with demo(*words, cwd=tmp_path) as running:
        assert running.process.wait(DEADLINE_S) == 0, running.process.stderr.read()
        running.until("^demo: ")
        *successes, report = re.fullmatch(LAST_LINE, running.lines[-1]).groups()
        assert processes_below(tmp_path) == []
    text = (tmp_path / report).read_text(encoding="utf-8")
    assert successes == ["1", "1"]
    assert (tmp_path / "out" / "paths.png").is_file()
    assert any("the deployed nodes reached the goal" in line for line in running.lines)
    perturbed = [
        line for line in running.lines if re.match("  (as it is|lidar): success", line)
    ]
    assert len(perturbed) == 2
    # episodes, predictions, yardsticks, and what is folded, all of it inside
    assert text.count("<img ") >= 6
    loads = re.findall(r"""\s(?:src|href|data)=["']?([^"'\s>]*)""", text)
    assert all(source.startswith("data:image/png;base64,") for source in loads)
    assert "<script" not in text
    for words in (
        "Verdict",
        "Fit report",
        "1 of 1 episodes",
        "The robot reached its goal",
        "mild",
    ):
        assert words in text
    # Commands go through a quaternion and back at most: the two drives are the same drive.
    episodes = text.partition("<h2>Paths in the world")[2].partition("<h2>")[0]
    assert episodes.count("<tr>") == 2  # a heading, and one episode
    deviations = re.findall(DEVIATION, episodes)
    assert len(deviations) == 1
    assert max(map(float, deviations)) < 1e-6
    if CHROMIUM:
        with closing(Browser(tmp_path / "browser")) as browser:
            assert browser.flaws((tmp_path / "out" / "report.html").as_uri()) == []


@needs_ros
@pytest.mark.parametrize(
    ("phase", "pattern", "episodes", "policy"),
    [
        pytest.param("training", "^  .* steps: success", 1, (), marks=campaign),
        pytest.param("in process", "^  seed 0: ", 1000, READY_MADE, marks=campaign),
        pytest.param(
            "over DDS", "^driving the same .* over DDS", 20, READY_MADE, marks=campaign
        ),
        pytest.param("in real time", "^deploying ", 1, READY_MADE, marks=campaign),
    ],
)
@pytest.mark.process
@pytest.mark.slow
def test_ctrl_c_ends_it_and_all_that_it_started(
    tmp_path, drive, phase, pattern, episodes, policy
):
    if phase == "training":
        pytest.importorskip("stable_baselines3")
    words = (
        "--episodes",
        episodes,
        "--world",
        "empty",
        "--out",
        "out",
        *policy,
        *drive,
    )
    with demo(*words, cwd=tmp_path) as running:
        running.until(pattern)
        if phase in ("over DDS", "in real time"):
            until(lambda: len(processes_below(tmp_path)) > 1, "a node", DEADLINE_S)
        os.kill(running.process.pid, signal.SIGINT)
        assert running.process.wait(30.0) == 130
        assert processes_below(tmp_path) == []
        error = running.process.stderr.read()
        assert error == "nics: interrupted; everything that was started has ended.\n"
