"""Drive to a goal with someone else's network, using a mapping of its inputs and outputs."""

from pathlib import Path

import numpy as np
from onnx import TensorProto, helper, numpy_helper, save

from nics_drl_bridge import load_world, make, open_model
from nics_drl_bridge.policy.evaluation import drive
from nics_drl_bridge.policy.policies import open_policy
from nics_drl_bridge.report.pictures import draw_trajectories

MAPPING = """
kind: foreign policy
network: theirs.onnx
scan: {sectors: 36, range_max: 3.0}
inputs:
  scan: {parts: [{of: scan}], divide: 3.0}
  goal: {parts: [{of: goal.distance, clip: [0.0, 5.0]}, {of: goal.bearing}]}
outputs:
  forward: {of: action, index: 0, clip: [0.0, 0.5]}
  turn: {of: action, index: 1, multiply: 2.0}
"""


def network():
    """A network that turns to the goal and slows down before obstacles."""
    weights = np.zeros((38, 2), np.float32)
    weights[15:21, 0] = 0.2
    weights[37, 1] = 1.0
    nodes = [
        helper.make_node("Concat", ["scan", "goal"], ["seen"], axis=1),
        helper.make_node("MatMul", ["seen", "weights"], ["raw"]),
        helper.make_node("Tanh", ["raw"], ["action"]),
    ]
    ends = {"scan": ["n", 36], "goal": ["n", 2], "action": ["n", 2]}
    infos = [
        helper.make_tensor_value_info(n, TensorProto.FLOAT, of)
        for n, of in ends.items()
    ]
    initial = [numpy_helper.from_array(weights, "weights")]
    graph = helper.make_graph(nodes, "theirs", infos[:2], infos[2:], initial)
    return helper.make_model(
        graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8
    )


def main():
    save(network(), "theirs.onnx")
    Path("theirs.yaml").write_text(MAPPING, encoding="utf-8")
    model = open_model("differential")
    world = load_world("empty")
    policy, task = open_policy("theirs.yaml", model)
    episode = drive(make(model=model, world=world, task=task), policy, seed=0)
    print(episode.result)
    picture = draw_trajectories(
        {"theirs": [episode]}, world, model.robot.footprint_radius
    )
    Path("drive_foreign_policy.png").write_bytes(picture)


if __name__ == "__main__":
    main()
