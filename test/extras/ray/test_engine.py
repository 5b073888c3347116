"""Training on a real Ray cluster of two nodes, both on this machine."""

import os
import signal
import subprocess
import sys
from functools import partial
from pathlib import Path

import pytest
from typer.testing import CliRunner

from nics_drl_bridge.commands.cli import app
from nics_drl_bridge.policy.file.policy_file import load_policy
from nics_drl_bridge.policy.train.settings import TrainingSettings, open_training

pytest.importorskip(
    "ray", reason="needs Ray, in an environment of its own; run 'nox -s ray'"
)

from ray.cluster_utils import Cluster

from nics_drl_bridge.extras.ray.engine import (
    FORMAT,
    connect,
    select_worlds,
    train_on_ray,
)
from nics_drl_bridge.policy.train.checkpoint import read_checkpoint
from nics_drl_bridge.policy.train.run import CHECKPOINT, TrainOrder, run

pytestmark = pytest.mark.timeout(
    600
)  # processes begin slowly on a machine with other work

STORE_BYTES = 100_000_000
RUNNERS = 2


class BrokenOffError(Exception):
    """As a user's Ctrl-C."""


@pytest.fixture(scope="module")
def cluster():
    """Two nodes with one CPU each: two env runners have to share them."""
    with pytest.MonkeyPatch.context() as patched:
        patched.setenv("RAY_USAGE_STATS_ENABLED", "0")
        patched.setenv(
            "RAY_worker_niceness", "0"
        )  # else other work may starve the workers
        node = {"num_cpus": 1, "object_store_memory": STORE_BYTES}
        head = {**node, "include_dashboard": False}
        made = Cluster(initialize_head=True, head_node_args=head)
        made.add_node(**node)
        yield made
        made.shutdown()


def settings(**changes):
    data = {
        "worlds": {"arena": 6, "empty": 3},
        "task_options": {"scan": "around"},
        "steps": 2000,
        "max_episode_steps": 20,
        "hidden": [8],
        "checkpoint_every": 144,
        "ppo": {"rollout": 16, "batch": 64, "epochs": 1},
    }
    return TrainingSettings.model_validate(data | changes)


def running_workers() -> dict[int, int]:
    """Process id -> that of its node, of the env runners below this process."""
    parents = {}
    names = {}
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                stat = (entry / "stat").read_text()
                names[int(entry.name)] = (entry / "cmdline").read_bytes()
            except (FileNotFoundError, ProcessLookupError):
                continue  # has just ended
            parents[int(entry.name)] = int(stat.rpartition(")")[2].split()[1])

    def is_ours(process: int) -> bool:
        while process in parents and process != os.getpid():
            process = parents[process]
        return process == os.getpid()

    return {
        process: parents[process]
        for process, name in names.items()
        if name.startswith(b"ray::WorldsRunner") and is_ours(process)
    }


def test_a_training_on_two_nodes_outlives_a_killed_worker_and_writes_its_policy_file(
    cluster, tmp_path
):
    killed = []
    told = []

    def tell(progress):
        told.append(progress)
        if len(told) == 2:
            workers = running_workers()
            assert len(workers) == RUNNERS
            assert len(set(workers.values())) == 2, "one on each node"
            killed.append(min(workers))
            os.kill(killed[0], signal.SIGKILL)

    order = TrainOrder(settings(), [3], tmp_path, episodes=10)
    with connect(cluster.address, RUNNERS, worlds=9) as runners:
        (result,) = run(order, tell, learn=partial(train_on_ray, runners=runners))
    assert killed
    assert told[-1].steps == result.trained.steps >= 2000
    path = tmp_path / "seed_3" / "policy.onnx"
    assert load_policy(path).contract.provenance["steps"] == result.trained.steps
    assert acts_alone(path)


def acts_alone(path: Path) -> bool:
    """Whether a policy file acts in a process that loads neither Ray nor PyTorch."""
    code = (
        "import sys, numpy as np\n"
        "from nics_drl_bridge.policy.file.policy_file import load_policy\n"
        "policy = load_policy(sys.argv[1])\n"
        "action = policy.act(np.zeros(policy.contract.observation.size, np.float32))\n"
        "assert np.isfinite(action).all() and np.abs(action).max() <= 1.0\n"
        "assert not {'torch', 'ray', 'stable_baselines3'} & set(sys.modules)\n"
    )
    return (
        subprocess.run([sys.executable, "-c", code, str(path)], check=False).returncode
        == 0
    )


def test_a_killed_worker_is_begun_anew_and_an_interrupted_run_goes_on_where_it_was(
    cluster, tmp_path
):
    endless = settings(steps=10**9)
    first = {}

    def until_it_is_back(progress):
        workers = running_workers()
        if not first:
            first.update(workers)
            os.kill(max(workers), signal.SIGKILL)
        elif len(workers) == RUNNERS and set(workers) - set(first):
            raise BrokenOffError

    def once(progress):
        first["resumed"] = progress.steps
        raise BrokenOffError

    with connect(cluster.address, RUNNERS, worlds=9) as runners:
        learn = partial(
            train_on_ray, *open_training(endless), endless, 0, tmp_path, runners=runners
        )
        with pytest.raises(BrokenOffError):
            learn(until_it_is_back)
        kept = read_checkpoint(tmp_path / CHECKPOINT, FORMAT)["steps"]
        with pytest.raises(BrokenOffError):
            learn(once, resumed=True)
    assert kept > 144
    assert kept < first["resumed"] <= kept + 3 * 144


def test_the_command_trains_on_a_cluster_and_leaves_what_training_on_one_machine_leaves(
    cluster, tmp_path
):
    path = tmp_path / "settings.yaml"
    out = tmp_path / "run"
    path.write_text(settings(steps=144).model_dump_json())
    where = ("--engine", "ray", "--address", cluster.address, "--out", out)
    options = ("--env-runners", RUNNERS, "--settings", path, "--episodes", 5)
    done = nics(*where, *options)
    assert done.exit_code == 0, done.output
    assert done.output.count("of 5 episodes") == 2
    names = {file.name.partition(".out")[0] for file in (out / "seed_0").iterdir()}
    assert names == {"policy.onnx", "evaluation.json", "checkpoint.npz", "events"}
    refused = nics("--resume", "--out", out)
    assert refused.exit_code == 2
    assert "resume with the same --engine" in refused.output


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        (["--env-runners", "3"], "--env-runners 3: the cluster has 2 CPUs"),
        (["--algorithm", "sac"], "learns with ppo, not 'sac'"),
        (["--address", "127.0.0.1:1"], "--address 127.0.0.1:1: no Ray cluster"),
        (["--address", "nonsense"], "--address nonsense: no Ray cluster"),
    ],
)
def test_what_can_not_be_trained_gives_one_sentence(
    cluster, tmp_path, arguments, reason
):
    where = ["--engine", "ray", "--out", tmp_path / "run"]
    if "--address" not in arguments:
        where += ["--address", cluster.address]
    done = nics(*where, *arguments)
    assert done.exit_code == 2
    assert reason in " ".join(done.output.split())
    assert "Traceback" not in done.output


def test_env_runners_share_all_worlds_among_them():
    shares = [
        select_worlds(*open_training(settings()), settings(), k, 4).num_envs
        for k in range(4)
    ]
    assert shares == [3, 2, 2, 2]


def nics(*arguments):
    return CliRunner().invoke(app, ["train", *map(str, arguments)])
