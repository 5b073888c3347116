"""The picture of a robot in RViz, without RViz."""

from pathlib import Path

import pytest
import yaml

FILE = Path(__file__).resolve().parents[2] / "config" / "rviz" / "bridge.rviz"
MANAGER = yaml.safe_load(FILE.read_text(encoding="utf-8"))["Visualization Manager"]
NAMED = {
    part.get("Topic", part.get("Description Topic"))["Value"]: part
    for part in (*MANAGER["Displays"], *MANAGER["Tools"])
    if "Topic" in part or "Description Topic" in part
}


def test_the_map_is_shown_to_who_comes_late_too():
    shown = NAMED["/map"]
    assert (shown["Class"], shown["Enabled"]) == ("rviz_default_plugins/Map", True)
    assert shown["Topic"]["Durability Policy"] == "Transient Local"
    assert shown["Topic"]["Reliability Policy"] == "Reliable"


def test_every_topic_of_the_picture_is_led_to_those_of_the_robot_and_the_map_to_that_of_all():
    pytest.importorskip("launch_ros", reason="needs launch: nox -s upstream")
    from nics_drl_bridge.config import find_config
    from nics_drl_bridge.nodes import starting

    arguments = {
        "params_file": str(find_config("bridge", "nodes")),
        "simulator": "simulator",
    }
    for given, place in (
        ({}, "/map"),
        ({"namespace": "car"}, "/car/map"),
        ({"namespace": "hall", "robots": "[a, b]"}, "/hall/map"),
    ):
        setup = starting.Setup(arguments | {"rviz_config": str(FILE)} | given)
        setup.node = lambda *given, **_: given
        *_, (*_, topics) = starting.description(setup)
        assert dict(topics)["/map"] == place
        assert dict(topics).keys() == NAMED.keys()
