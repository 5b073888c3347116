"""Arrays in files: equal bytes, mapped, sealed."""

from __future__ import annotations

import hashlib
import io
import zipfile

import numpy as np
import pytest

from nics_drl_bridge import npz
from nics_drl_bridge.files import write_bytes
from nics_drl_bridge.npz import npz_arrays, npz_bytes, npz_mapped


def test_equal_arrays_give_equal_bytes_and_read_back():
    arrays = {"a": np.arange(5), "b": np.ones((2, 3), np.float32)}
    data = npz_bytes(arrays)
    assert data == npz_bytes({name: array.copy() for name, array in arrays.items()})
    with np.load(io.BytesIO(data), allow_pickle=False) as read:
        assert read["b"].dtype == np.float32
        assert all(np.array_equal(read[name], array) for name, array in arrays.items())


def test_the_bytes_of_arrays_do_not_hold_the_date():
    assert b"\x00\x00\x21\x00" in npz_bytes({"a": np.zeros(1)})[:20]  # 1 January 1980


MIXED = {
    "a": np.arange(1000, dtype=np.int16),
    "b": np.ones((2, 3), np.float32),
    "empty": np.zeros((0, 4)),
    "single": np.array(3.0),
}


@pytest.mark.parametrize("packed", [False, True])
def test_mapped_arrays_are_those_that_were_written(tmp_path, packed):
    path = tmp_path / "arrays.npz"
    write_bytes(path, npz_bytes(MIXED, packed))
    back = npz_mapped(path)
    assert list(back) == list(MIXED)
    for name, array in MIXED.items():
        assert back[name].dtype == array.dtype
        assert np.array_equal(back[name], array)
    assert np.array_equal(npz_arrays(path.read_bytes())["a"], MIXED["a"])


def test_mapped_arrays_are_aligned_and_their_file_is_never_written(tmp_path):
    path = tmp_path / "arrays.npz"
    data = npz_bytes(MIXED, packed=False)
    write_bytes(path, data)
    back = npz_mapped(path)
    for name in ("a", "b"):
        assert isinstance(back[name].base, np.memmap)
        assert back[name].ctypes.data % npz.ALIGNMENT == 0
        back[name][...] = 0
    assert path.read_bytes() == data


@pytest.mark.parametrize("packed", [False, True])
def test_every_flipped_bit_and_every_cut_is_a_value_error(tmp_path, packed):
    data, rng = npz_bytes(MIXED, packed), np.random.default_rng(0)
    path = tmp_path / "arrays.npz"
    for trial in range(400):
        damaged = bytearray(data)
        damaged[rng.integers(len(data))] ^= 1 << rng.integers(8)
        path.write_bytes(damaged[: rng.integers(len(data))] if trial % 4 == 0 else damaged)
        with pytest.raises(ValueError, match=r".+"):
            npz_mapped(path)
        with pytest.raises(ValueError, match=r".+"):
            npz_arrays(path.read_bytes())


@pytest.mark.parametrize("field", [{"method": 99}, {"flags": 1}], ids=["packing", "password"])
def test_entries_that_zipfile_can_not_unpack_are_a_value_error(tmp_path, field):
    data = bytearray(npz_bytes({"a": np.arange(1000)}))
    for signature, flags, method in ((b"PK\x03\x04", 6, 8), (b"PK\x01\x02", 8, 10)):
        begin = data.index(signature)
        data[begin + (flags if "flags" in field else method)] = next(iter(field.values()))
    path = tmp_path / "arrays.npz"
    path.write_bytes(sealed_anew(data))
    with pytest.raises(ValueError, match=r"compression|password|encrypted"):
        npz_mapped(path)
    with pytest.raises(ValueError, match=r"compression|password|encrypted"):
        npz_arrays(path.read_bytes())


def sealed_anew(data):
    return data[:-64] + hashlib.sha256(data[:-64]).hexdigest().encode()


def test_objects_are_refused_since_they_would_have_to_be_unpickled():
    with pytest.raises(ValueError, match="allow_pickle"):
        npz_bytes({"a": np.array([object()])})


def archive(**parts: bytes) -> bytes:
    """An archive of packed parts with a checksum that fits."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as made:
        for name, data in parts.items():
            made.writestr(f"{name}.npy", data)
        made.comment = b"sha256 " + bytes(64)
    data = buffer.getvalue()[:-64]
    return data + hashlib.sha256(data).hexdigest().encode()


def test_an_archive_that_unpacks_to_gigabytes_is_refused_packed(monkeypatch, tmp_path):
    data = archive(zeros=bytes(3_000_000))
    monkeypatch.setattr(npz, "MOST_BYTES", 2_000_000)
    path = tmp_path / "zeros.npz"
    path.write_bytes(data)
    for read in (lambda: npz.npz_arrays(data), lambda: npz.npz_mapped(path)):
        with pytest.raises(ValueError, match="unpacked it is larger than"):
            read()


def test_a_file_that_is_too_large_is_not_read(tmp_path):
    path = tmp_path / "large.npz"
    with path.open("wb") as file:
        file.truncate(npz.MOST_BYTES + 1)
    with pytest.raises(ValueError, match="larger than 256 MB"):
        npz.npz_mapped(path)
