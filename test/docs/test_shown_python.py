"""The Python of each page is run, block after block in one process, in a folder of its own."""

from __future__ import annotations

import re
import subprocess
import sys
from importlib.util import find_spec

import pytest

from docs.test_pages import FENCED, PAGES, ROOT, text_of

NEEDED = ("pettingzoo", "onnx", "torch", "stable_baselines3")
SHORT = {"num_envs=256": "num_envs=2", "1_000_000": "256", "100_000": "256"}
AGENT = """
import gymnasium
import nics_drl_bridge
from nics_drl_bridge.policy.policies import make_policy
from nics_drl_bridge.policy.train.vec_env import TrainVecEnv
from stable_baselines3 import PPO

envs = gymnasium.make_vec("NicsBridge/Navigation-v0", num_envs=2, autoreset_mode="SameStep")
agent = PPO("MlpPolicy", TrainVecEnv(envs.unwrapped), n_steps=8, batch_size=8, device="cpu")
"""
BEFORE = {
    ("policy_file.md", 0): AGENT.replace(
        ", num_envs", ", task_options={'scan': 'around'}, num_envs"
    ),
    ("policy_file.md", 1): "observation, _ = env.reset(seed=0)\n",
    ("howto.md", 0): AGENT,
    ("tasks.md", 0): "import gymnasium\nimport nics_drl_bridge\n",
    ("extensions.md", 0): "import gymnasium\n",  # before what imports the package
}
"""What a reader has by then."""
ELSEWHERE = {
    ("howto.md", 1): "needs a simulator in another process",
    ("policy_file.md", 3): "needs a policy with a state",
}
SAVED = {("tasks.md", 1): "my_task.py"}


def blocks_of(page):
    found = FENCED.finditer(text_of(page))
    return [one["text"] for one in found if one["kind"] == "python"]


def script_of(page, folder):
    """The blocks that are run, as one script; some are files of their own besides."""
    parts = []
    for number, text in enumerate(blocks_of(page)):
        at = page.name, number
        if at in SAVED:
            (folder / SAVED[at]).write_text(text)
        if at not in ELSEWHERE:
            parts.append(BEFORE.get(at, "") + text)
    pattern = re.compile("|".join(SHORT))
    return pattern.sub(lambda match: SHORT[match[0]], "\n".join(parts))


@pytest.mark.skipif(None in map(find_spec, NEEDED), reason="the pages use all extras")
@pytest.mark.process
@pytest.mark.slow
@pytest.mark.timeout(600)
@pytest.mark.parametrize(
    "page", [page for page in PAGES if blocks_of(page)], ids=lambda p: p.name
)
def test_the_python_of_a_page_runs_as_it_is_shown(page, tmp_path):
    (tmp_path / "examples").symlink_to(ROOT / "examples")
    script = tmp_path / "shown.py"
    script.write_text(script_of(page, tmp_path))
    done = subprocess.run(
        [sys.executable, str(script)],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
