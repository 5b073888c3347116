from __future__ import annotations

import json
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
from command_line import nics
from domains import claimed_domain

from nics_drl_bridge import defaults, geometry
from nics_drl_bridge.commands.vehicle_goals import GoalOrder
from nics_drl_bridge.config import dump_yaml
from nics_drl_bridge.errors import ConfigError
from nics_drl_bridge.robot.spec import load_robot

ROOT = Path(__file__).resolve().parents[1]
PNG = b"\x89PNG"
DEADLINE_S = 100.0
missing = [name for name in ("rclpy", "mujoco") if find_spec(name) is None]
needs_nodes = pytest.mark.skipif(bool(missing), reason=f"needs {' and '.join(missing)}")


@pytest.fixture
def domain_id(monkeypatch):
    with claimed_domain() as domain_id:
        monkeypatch.setenv("ROS_DOMAIN_ID", str(domain_id))
        monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
        yield domain_id


def driven(done, folder):
    """What an evaluation into the folder `out` wrote."""
    assert done.returncode == 0, done.stderr
    file = folder / "out" / "evaluation.json"
    return json.loads(file.read_text(encoding="utf-8"))


BASELINE = "evaluate dynamic_window --model differential --episodes 2 --out out"


def test_an_evaluation_in_the_folder_of_another_says_that_it_replaces_it(tmp_path):
    words = "evaluate straight --in fast --episodes 1 --world empty --out out"
    first, second = (nics(words, cwd=tmp_path) for _ in range(2))
    assert (first.returncode, second.returncode) == (0, 0)
    assert "replaced" not in first.stderr
    assert "out: the existing evaluation.json will be replaced" in second.stderr


@pytest.mark.ros
@pytest.mark.process
@pytest.mark.slow
@needs_nodes
def test_the_same_episodes_are_driven_in_process_over_dds_and_by_other_physics(
    tmp_path, domain_id
):
    conditions = {
        "lidar": "rplidar_a2",
        "randomisation": "mild",
        "gate": "differential",
    }
    words = [f"--{name}={value}" for name, value in conditions.items()]
    places = "--in fast --in dds --in mujoco_dds"
    done = nics(BASELINE, *words, places, cwd=tmp_path)
    told = driven(done, tmp_path)
    others = {"steps": 300, "task": {}, "kind": None}
    assert told["conditions"] == conditions | others
    figures = told["policies"]["dynamic_window"].values()
    fast, dds, mujoco = figures
    for place in figures:
        assert [one["seed"] for one in place["each"]] == [1_000_000, 1_000_001]
        assert [one["goal"] for one in place["each"]] == [
            one["goal"] for one in fast["each"]
        ]
    assert dds["same"] == 1.0
    assert dds["greatest_deviation"] < 1e-6  # the same numbers, by way of messages
    assert mujoco["greatest_deviation"] > 0.001  # another machine, the same goals
    assert all(one["result"] == "success" for one in mujoco["each"])
    picture = tmp_path / "out" / "trajectories_dynamic_window.png"
    assert picture.read_bytes().startswith(PNG)
    assert "dynamic_window: success in process " in done.stdout


@pytest.mark.slow
def test_a_policy_of_a_task_of_ones_own_is_driven_by_the_file_of_the_task(tmp_path):
    pytest.importorskip("torch")
    from policy.policy_rig import network

    from nics_drl_bridge.env.registry import make_task
    from nics_drl_bridge.generator import builtin_model
    from nics_drl_bridge.policy.train.export import export_policy

    kind = f"{ROOT / 'examples' / 'own_task.py'}:Patrol"
    model = builtin_model("differential")
    task = make_task(kind, model, {"scan": 24})
    size = task.observation_space.shape[0]
    export_policy(network(size, 2), task, model, tmp_path / "patrol.onnx", None, {})
    words = "evaluate patrol.onnx --in fast --world empty --episodes 1"
    done = nics(words, cwd=tmp_path)
    assert done.returncode == 2
    assert "give --task path/to/file.py:Patrol" in done.stderr
    done = nics(words, "--task", kind, "--out out", cwd=tmp_path)
    told = driven(done, tmp_path)
    assert told["conditions"]["kind"] == kind
    assert len(told["policies"]["patrol.onnx"]["fast"]["each"]) == 1
    done = nics("evaluate straight --task", kind, "--in fast", cwd=tmp_path)
    assert "policy 'straight' only drives the task 'navigation'" in done.stderr


@pytest.mark.slow
def test_several_policies_drive_the_same_episodes_in_one_table(tmp_path):
    words = "evaluate dynamic_window random --in fast --episodes 3 --seed 7"
    done = nics(words, "--model ackermann --out out", cwd=tmp_path)
    told = driven(done, tmp_path)
    one, other = (policy["fast"]["each"] for policy in told["policies"].values())
    assert [each["goal"] for each in one] == [each["goal"] for each in other]
    assert [each["path"][0] for each in one] == [each["path"][0] for each in other]
    assert {path.name for path in (tmp_path / "out").iterdir()} == {
        "evaluation.json",
        "trajectories_dynamic_window.png",
        "trajectories_random.png",
    }


@pytest.fixture
def far_from_the_origin(tmp_path, monkeypatch, domain_id):
    """A robot on a wide field whose odometry began elsewhere, behind what a gate listens to."""
    from nics_drl_bridge.commands import episodes as vehicle
    from nics_drl_bridge.nodes.operator import Witness
    from nics_drl_bridge.nodes.processes import NodeProcess

    world = tmp_path / "wide.yaml"
    world.write_text(
        "name: wide\nbounds: [-40, -40, 40, 40]\ngoal_distance: [2.0, 4.0]\n"
    )
    given = {
        "model": "differential",
        "world": str(world),
        "enable_stamped_cmd_vel": True,
    }
    given |= {"episode_start": [18.0, 5.0, 2.0], "mode": "realtime"}
    monkeypatch.setattr(
        vehicle, "examine", lambda facts, expected: []
    )  # of a busy machine
    monkeypatch.setattr(defaults, "LISTEN_S", 0.1)
    raw = {"cmd_vel": "cmd_vel_raw"}
    logs = tmp_path / "logs"
    with (
        NodeProcess("simulator_node", logs, given, domain_id, remap=raw) as node,
        Witness(domain_id) as witness,
    ):
        assert witness.sees(DEADLINE_S), node.log.read_text(encoding="utf-8")
        yield witness


def vehicle_order(folder):
    from nics_drl_bridge.commands import episodes as vehicle

    return vehicle.EvaluationOrder(
        ["dynamic_window"], folder, "differential", "circles", 1, 0
    )


@pytest.mark.ros
@pytest.mark.process
@needs_nodes
def test_a_goal_lies_where_it_was_given_wherever_odometry_began(
    tmp_path, far_from_the_origin
):
    from nics_drl_bridge.commands import episodes as vehicle

    said = []
    options = {"stale_after_s": DEADLINE_S, "stamped": True}
    order = vehicle_order(tmp_path / "out")

    def drive(goal, frame=None):
        goals = GoalOrder(goal, frame, "present")
        drive = vehicle.VehicleDrive(order, goals, said.append, said.append)
        return drive.run(**options)

    # In the map it is far away, which nobody has confirmed.
    far = r"\(2.00 m, 0.50 m\) in map, 16.\d+ m from where it stands, farther than 5 m.*use --yes"
    with pytest.raises(ConfigError, match=far):
        drive((2.0, 0.5), "map")
    witnessed = far_from_the_origin.path
    assert np.ptp(witnessed[:, :2], axis=0).max() < 0.01
    assert witnessed[0] == pytest.approx([18.0, 5.0, 2.0], abs=0.1)
    driven = drive((1.0, 0.5)).runs["vehicle"][0]
    assert any(
        "it will drive to 1.00 m ahead and 0.50 m to the left" in line for line in said
    )
    assert driven.result == "success", said
    assert driven.goal == pytest.approx([1.0, 0.5])
    assert driven.path[0] == pytest.approx(np.zeros(3), abs=0.1)
    truly = geometry.between(witnessed[0], far_from_the_origin.path[-1])[:2]
    assert np.hypot(*(truly - [1.0, 0.5])) < 0.5
    assert driven.length < 3.0


def test_a_far_goal_is_refused_before_anything_is_waited_for_where_nobody_can_be_asked(
    tmp_path,
):
    words = f"{BASELINE} --hardware --start present --goal 20,0"
    done = nics(words, cwd=tmp_path)
    assert done.returncode == 2
    sentence = done.stderr.splitlines()[-1]
    assert "it will drive to 20.00 m ahead" in sentence
    assert "farther than 5 m: nobody can confirm that here; use --yes" in sentence


@pytest.mark.ros
@pytest.mark.process
@pytest.mark.campaign
@needs_nodes
def test_a_vehicle_that_does_not_fit_its_model_is_not_driven(tmp_path, domain_id):
    done = nics(f"{BASELINE} --hardware --yes", cwd=tmp_path)  # nobody is there
    assert done.returncode == 2
    assert "the vehicle is not driven: " in done.stderr.splitlines()[-1]
    assert not (tmp_path / "out").exists()


@pytest.mark.ros
@pytest.mark.process
@pytest.mark.slow
@pytest.mark.campaign
@needs_nodes
def test_a_vehicle_is_driven_in_real_time_through_the_armed_gate(
    tmp_path, monkeypatch, domain_id
):
    from nics_drl_bridge.commands import episodes as vehicle
    from nics_drl_bridge.nodes.operator import Witness
    from nics_drl_bridge.nodes.processes import NodeProcess

    limits = {
        one.name: {"min": one.min, "max": one.max, "rate": 20.0, "jerk": 400.0}
        for one in load_robot("differential").command
    }
    file = tmp_path / "limits.yaml"
    file.write_text(
        dump_yaml({"robot": "differential", "commands": limits}), encoding="utf-8"
    )
    model = {"model": "differential"}
    logs = tmp_path / "logs"
    said = []
    gate = model | {"limits": str(file), "black_box": str(tmp_path / "black_box")}
    gate |= {"use_sim_time": True, "e_stop_required": False}
    # What a busy machine does to rates and ages would be a finding; that is tested elsewhere.
    monkeypatch.setattr(vehicle, "examine", lambda facts, expected: [])
    out = tmp_path / "out"
    order = vehicle.EvaluationOrder(
        ["dynamic_window"], out, "differential", "empty", 1, 0
    )
    world = model | {"world": "empty"}
    with (
        NodeProcess("simulator_node", logs, world, domain_id),
        NodeProcess("middleware_node", logs, model, domain_id),
        NodeProcess("command_gate", logs, gate, domain_id),
    ):
        with Witness(domain_id) as witness:  # it may be compiling
            assert witness.sees(DEADLINE_S)
        drive = vehicle.VehicleDrive(
            order, GoalOrder(start="present"), said.append, said.append, arm=True
        )
        made = drive.run(stale_after_s=DEADLINE_S)
    assert "  command_gate is armed" in said
    assert any("it will drive to" in line for line in said)
    (driven,), (beside,) = made.runs.values()
    assert driven.length > 0.3  # the gate let commands pass
    assert list(driven.path[0]) == list(beside.path[0])
    assert list(driven.goal) == list(beside.goal)
    told = json.loads(
        (tmp_path / "out" / "evaluation.json").read_text(encoding="utf-8")
    )
    assert list(told["policies"]["dynamic_window"]) == ["vehicle", "fast"]
