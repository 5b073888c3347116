"""A control group limits what its processes take of a core."""

import subprocess
import sys
import time

import pytest

from nics_drl_bridge.nodes.load import CoreShare, read_cpu_time

SPENT_S = 0.5
POLL_S = 0.01
DEADLINE_S = 60.0
BUSY = "import time\nwhile True: pass"


def make_group(root, monkeypatch):
    """A group in a folder that is no control group, in which files stay."""
    monkeypatch.setattr(CoreShare, "__exit__", lambda *_: None)
    return CoreShare(root)


def read_files(root):
    files = (file for file in root.rglob("*") if file.is_file())
    return {file.name: file.read_text() for file in files}


def test_a_limit_is_written_as_the_second_version_of_control_groups_reads_it(
    tmp_path, monkeypatch
):
    (tmp_path / "cgroup.controllers").write_text("cpu memory")
    group = make_group(tmp_path, monkeypatch)
    group.add(12)
    group.limit(0.25)
    written = read_files(tmp_path)
    assert written["cgroup.subtree_control"] == "+cpu"
    assert written["cgroup.procs"] == "12"
    assert written["cpu.max"] == "25000 100000"


def test_a_limit_is_written_as_the_first_version_of_control_groups_reads_it(
    tmp_path, monkeypatch
):
    (tmp_path / "cpu").mkdir()
    group = make_group(tmp_path, monkeypatch)
    group.limit(0.5)
    written = read_files(tmp_path / "cpu")
    assert written["cpu.cfs_quota_us"] == "50000"
    assert written["cpu.cfs_period_us"] == "100000"


def test_without_control_groups_it_says_which_file_is_not_there(tmp_path):
    with pytest.raises(OSError, match="No such file") as refused:
        CoreShare(tmp_path)
    assert str(tmp_path) in refused.value.filename


@pytest.mark.process
@pytest.mark.skipif(sys.platform != "linux", reason="needs Linux")
def test_a_busy_process_takes_its_share_and_not_more():
    try:
        group = CoreShare()
    except OSError as error:
        pytest.skip(f"this user makes no control groups: {error}")
    with group, subprocess.Popen([sys.executable, "-c", BUSY]) as busy:
        try:
            group.add(busy.pid)
            group.limit(0.25)
            begin_s = time.monotonic()
            enough_s = read_cpu_time(busy.pid) + SPENT_S
            while read_cpu_time(busy.pid) < enough_s:
                assert time.monotonic() - begin_s < DEADLINE_S
                time.sleep(POLL_S)
            lasted_s = time.monotonic() - begin_s
        finally:
            busy.kill()
    assert lasted_s > 0.7 * SPENT_S / 0.25  # without the limit, it could be SPENT_S
