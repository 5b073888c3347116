import shutil

import numpy as np
import pytest

pytest.importorskip("rosbags", reason="needs the extra 'bags'")

import bags

from nics_drl_bridge.errors import RecordingError
from nics_drl_bridge.extras.bags.info import read_bag_info
from nics_drl_bridge.recording import textbook
from nics_drl_bridge.recording.write import write_bag
from nics_drl_bridge.robot.spec import load_robot

CAR = load_robot("ackermann")


@pytest.fixture(scope="module")
def pristine(tmp_path_factory):
    bag = tmp_path_factory.mktemp("pristine") / "sealed"
    write_bag(textbook.record(CAR, np.random.default_rng(0), duration=4.0), bag, CAR)
    return bag


MANY = (pytest.param(seed, marks=pytest.mark.campaign) for seed in range(5, 60))


@pytest.mark.parametrize("seed", [*range(5), *MANY])
def test_any_flipped_bit_of_a_bag_with_checksums_is_found(pristine, tmp_path, seed):
    bag = shutil.copytree(pristine, tmp_path / "sealed")
    (file,) = bag.glob("*.mcap")
    data = bytearray(file.read_bytes())
    rng = np.random.default_rng(seed)
    data[rng.integers(len(data))] ^= 1 << int(rng.integers(8))
    file.write_bytes(data)
    with pytest.raises(RecordingError):
        read_bag_info(bag)


def test_info_tells_rates_gaps_and_clocks(tmp_path):
    poses = [row for row in bags.poses(offset=100.0) if not 2.0 < row[0] < 4.0]
    bag = bags.write(tmp_path / "bag", {"/cmd_vel": bags.commands(), "/pose": poses})
    told = {topic.topic: topic for topic in read_bag_info(bag).topics}
    command = told["/cmd_vel"]
    pose = told["/pose"]
    assert command.rate_hz == pytest.approx(10.0)
    assert (command.clock, command.gaps) == ("no header", 0)
    assert pose.rate_hz == pytest.approx(50.0)
    assert (pose.clock, pose.gaps) == ("another", 1)
    assert pose.longest_gap_s == pytest.approx(2.0, abs=0.05)
    assert pose.delay_s == pytest.approx(-99.998)
    assert read_bag_info(bag).messages == len(bags.commands()) + len(poses)


def test_stamps_of_several_clocks_are_told(tmp_path):
    poses = [
        (t, bags.pose_stamped(t + 50.0 * (t > 3.0), 0.0, 0.0, 0.0))
        for t in bags.times()
    ]
    bag = bags.write(tmp_path / "bag", {"/pose": poses})
    (pose,) = read_bag_info(bag).topics
    assert pose.clock == "several"
