from __future__ import annotations

import pytest

pytest.importorskip("rosbags", reason="needs the extra 'bags'")

import lz4.frame

from nics_drl_bridge.recording import mcap
from nics_drl_bridge.recording.mcap import check_message, unpack, unpack_file

ZSTD = mcap._zstd()
PACK = {"zstd": ZSTD.compress, "lz4": lz4.frame.compress}
PLAIN = bytes(range(256)) * 40


@pytest.mark.parametrize("kind", PACK)
def test_what_was_packed_comes_out(kind):
    assert unpack(PACK[kind](PLAIN), kind, len(PLAIN)) == PLAIN
    assert unpack(PACK[kind](PLAIN), kind) == PLAIN


@pytest.mark.parametrize("kind", PACK)
def test_more_than_was_said_or_is_allowed_is_refused(kind, monkeypatch):
    with pytest.raises(ValueError, match="more than 10239 bytes"):
        unpack(PACK[kind](PLAIN), kind, len(PLAIN) - 1)
    monkeypatch.setattr(mcap, "MOST_UNPACKED", 1000)
    with pytest.raises(ValueError, match="more than 1000 bytes"):
        unpack(PACK[kind](PLAIN), kind, 10**18)


@pytest.mark.parametrize("kind", PACK)
def test_what_is_cut_off_is_refused(kind):
    with pytest.raises(ValueError, match="cut off"):
        unpack(PACK[kind](PLAIN)[:-5], kind)


def test_a_file_of_zeros_that_unpacks_to_thousands_of_times_its_length_is_refused(
    tmp_path, monkeypatch
):
    monkeypatch.setattr(mcap, "MOST_UNPACKED", 2**20)
    path = tmp_path / "bag.db3.zst"
    path.write_bytes(ZSTD.compress(bytes(2**26)))
    with pytest.raises(ValueError, match="1000 times"):
        unpack_file(path, tmp_path / "bag.db3")
    path.write_bytes(ZSTD.compress(PLAIN))
    assert unpack_file(path, tmp_path / "bag.db3").read_bytes() == PLAIN


def test_a_message_has_to_say_how_long_it_is(monkeypatch):
    check_message(ZSTD.compress(PLAIN))
    monkeypatch.setattr(mcap, "MOST_UNPACKED", 1000)
    with pytest.raises(ValueError, match="10240 bytes"):
        check_message(ZSTD.compress(PLAIN))
