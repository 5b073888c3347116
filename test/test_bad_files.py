"""Whatever is wrong with a file: one sentence that names it, never a traceback."""

import shutil
from pathlib import Path

import numpy as np
import pytest
from bad_files import FILES, TEXTS

from nics_drl_bridge.config import MAX_BYTES, share_folder
from nics_drl_bridge.errors import BridgeError, ConfigError
from nics_drl_bridge.gate.black_box import replay
from nics_drl_bridge.gate.limits import load_limits
from nics_drl_bridge.lidar.maps import load_map
from nics_drl_bridge.lidar.spec import load_lidar
from nics_drl_bridge.lidar.table import LidarTable
from nics_drl_bridge.policy.file.policy_file import load_policy
from nics_drl_bridge.policy.train.settings import load_training
from nics_drl_bridge.recording.recording import load_recording
from nics_drl_bridge.recording.topic_roles import load_topic_roles
from nics_drl_bridge.robot.spec import load_robot
from nics_drl_bridge.sim.randomisation import load_randomisation
from nics_drl_bridge.sim.world import load_world

CONFIGS = {
    "robots/ackermann.yaml": load_robot,
    "lidars/rplidar_a1.yaml": load_lidar,
    "worlds/doorway.yaml": load_world,
    "limits/differential.yaml": lambda name: load_limits(
        name, load_robot("differential")
    ),
    "randomisation/strong.yaml": load_randomisation,
    "training/navigation_differential.yaml": load_training,
    "maps/room.yaml": load_map,
}
OTHERS = {
    "policy.onnx": load_policy,
    "stop.jsonl": replay,
    "topics.yaml": load_topic_roles,
    "drive.npz": load_recording,
    "lidar_table": LidarTable.load,
}


def refused(load, path):
    with pytest.raises(BridgeError) as told:
        load(path)
    sentence = str(told.value)
    assert path.name in sentence
    assert "\n" not in sentence
    assert len(sentence) < 400


@pytest.fixture
def copy(tmp_path):
    def make(name):
        shutil.copy(share_folder() / "config" / "maps" / "room.pgm", tmp_path)
        return Path(shutil.copy(share_folder() / "config" / name, tmp_path))

    return make


@pytest.mark.parametrize("what", FILES | TEXTS)
@pytest.mark.parametrize("name", CONFIGS)
def test_a_damaged_configuration_is_refused_by_name(copy, name, what):
    path = copy(name)
    (FILES | TEXTS)[what](path)
    refused(lambda path: CONFIGS[name](str(path)), path)


@pytest.mark.parametrize("what", FILES)
@pytest.mark.parametrize("name", OTHERS)
def test_a_damaged_file_is_refused_by_name(tmp_path, name, what):
    path = tmp_path / name
    path.write_text("{}\n")
    FILES[what](path)
    refused(OTHERS[name], path)


WRITTEN = (
    "checkpoint.npz",
    "drive.npz",
    "model",
    "policy.onnx",
    "stop.jsonl",
    "table",
)


@pytest.fixture(params=WRITTEN)
def loader(request):
    """How a kind of file or folder is written whole, and read."""
    for library in ("onnx", "rosbags", "torch"):
        pytest.importorskip(library, reason=f"needs {library}")
    from campaigns.parts import loaders

    return next(one for one in loaders.WRITTEN if one.name == request.param)


@pytest.mark.slow
def test_every_flipped_bit_every_cut_and_every_missing_file_is_refused(
    tmp_path, loader
):
    path = tmp_path / loader.name
    loader.write(path, 0)
    loader.read(path)
    rng = np.random.default_rng(0)
    for file in [one for one in (path, *path.rglob("*")) if one.is_file()]:
        content = file.read_bytes()
        for trial in range(24):
            damaged = bytearray(content)
            # The head of an array is a small part of it; half of the trials go there.
            place = rng.integers(min(128 if trial % 2 else 2**30, len(content)))
            damaged[place] ^= 1 << rng.integers(8)
            file.write_bytes(damaged if trial % 4 else content[:place])
            with pytest.raises(BridgeError, match=loader.name):
                loader.read(path)
        file.unlink()
        with pytest.raises(BridgeError, match=file.name):
            loader.read(path)
        file.write_bytes(content)


def test_a_huge_configuration_or_an_endless_device_is_refused_without_reading_it(
    tmp_path,
):
    path = tmp_path / "huge.yaml"
    with path.open("wb") as huge:
        huge.truncate(MAX_BYTES + 1)
    with pytest.raises(ConfigError, match=r"huge\.yaml: is larger than 1 MB"):
        load_robot(str(path))
    endless = tmp_path / "endless.yaml"
    endless.symlink_to("/dev/zero")
    with pytest.raises(ConfigError, match="is a device or a pipe, not a file"):
        load_robot(str(endless))
