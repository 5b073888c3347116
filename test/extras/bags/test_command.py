import json

import pytest
from typer.testing import CliRunner

pytest.importorskip("rosbags", reason="needs the extra 'bags'")

import bags

from nics_drl_bridge.commands.cli import app


def nics(*words):
    return CliRunner().invoke(app, list(map(str, words)))


def cut(bag, share):
    """A bag whose end is missing."""
    (file,) = bag.glob("*.mcap")
    file.write_bytes(file.read_bytes()[: int(share * file.stat().st_size)])
    return bag


@pytest.fixture
def damaged(tmp_path):
    return cut(bags.write(tmp_path / "bag", bags.drive()), 0.7)


def test_info_prints_a_table_or_json(tmp_path):
    bag = bags.write(tmp_path / "bag", bags.drive())
    told = nics("bag", "info", bag)
    assert told.exit_code == 0, told.output
    assert "geometry_msgs/msg/PoseStamped" in told.stdout
    facts = json.loads(nics("bag", "info", bag, "--json").stdout)
    assert facts["messages"] == 360
    assert [topic["topic"] for topic in facts["topics"]] == ["/cmd_vel", "/pose"]


@pytest.mark.parametrize(
    "words",
    [("bag", "info"), ("bag", "replay", "--estimate"), ("doctor",)],
)
def test_a_damaged_bag_is_one_sentence_for_every_command(damaged, words):
    told = nics(*words, damaged)
    assert told.exit_code == 2
    (sentence,) = told.stderr.splitlines()
    assert sentence.startswith(f"nics: {damaged}: ")
    assert "mcap recover" in sentence
