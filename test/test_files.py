import io
import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

from nics_drl_bridge import files
from nics_drl_bridge.errors import ConfigError, ModelError
from nics_drl_bridge.files import (
    MOST_BYTES,
    SUMS,
    check_folder,
    check_sealed,
    check_sums,
    hash_bytes,
    seal,
    write_bytes,
    write_sums,
    write_text,
    write_whole_folder,
)

MARKER = "model.yaml"


class Crash(BaseException):
    """What a kill looks like from inside."""


def tree(folder):
    """Every file below a folder with its content."""
    return {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


@pytest.fixture
def old(tmp_path):
    """A folder of the right kind, written earlier."""
    folder = tmp_path / "out"
    folder.mkdir()
    (folder / MARKER).write_text("old")
    (folder / "extra").write_text("old too")
    return folder


def fill(folder):
    (folder / MARKER).write_text("new")
    (folder / "sub").mkdir()
    (folder / "sub" / "deep").write_text("deep")


WRITER = """
import sys
from pathlib import Path
from nics_drl_bridge.files import write_whole_folder
while True:
    for word in ("new", "old"):
        with write_whole_folder(Path(sys.argv[1]), "model.yaml") as temporary:
            (temporary / "model.yaml").write_text(word)
            (temporary / "extra").write_text(word + " too")
"""


@pytest.mark.process
def test_a_folder_is_whole_at_every_moment_while_two_write_it_and_are_killed(old):
    writers = [
        subprocess.Popen([sys.executable, "-c", WRITER, str(old)]) for _ in range(2)
    ]
    try:
        seen = set()
        deadline = time.monotonic() + 60.0
        while len(seen) < 2 and time.monotonic() < deadline:
            # One folder, however often its name changes hands meanwhile.
            folder = os.open(old, os.O_RDONLY | os.O_DIRECTORY)
            try:
                with open(os.open(MARKER, os.O_RDONLY, dir_fd=folder)) as file:
                    word = file.read()
                assert word in ("new", "old")
                seen.add(word)
            except FileNotFoundError:
                pass  # replaced and removed after it was opened
            finally:
                os.close(folder)
    finally:
        for writer in writers:
            writer.kill()
            writer.wait()
    assert seen == {"new", "old"}
    assert (old / "extra").read_text() == (old / MARKER).read_text() + " too"


@pytest.fixture(params=[0o022, 0o077], ids=oct)
def umask(request):
    before = os.umask(request.param)
    yield request.param
    os.umask(before)


def test_the_umask_decides_who_may_read_what_is_written(tmp_path, umask):
    for text in ("long text", "text"):
        write_text(tmp_path / "a" / "file", text)
    assert tree(tmp_path) == {"a/file": b"text"}
    with write_whole_folder(tmp_path / "folder", MARKER) as temporary:
        fill(temporary)
        write_text(temporary / "more", "text")
    for path in (tmp_path / "a", tmp_path / "folder", tmp_path / "folder" / "sub"):
        assert path.stat().st_mode & 0o777 == 0o777 & ~umask, path
    for path in (tmp_path / "a" / "file", tmp_path / "folder" / "more"):
        assert path.stat().st_mode & 0o777 == 0o666 & ~umask, path


LEAVING = """
import sys
from pathlib import Path
from nics_drl_bridge import files

def parts():
    yield b"half"
    print("begun", flush=True)
    sys.stdin.read()
    yield b"whole"

path = Path(sys.argv[2])
if sys.argv[1] == "file":
    files.write_parts(path, parts())
elif sys.argv[1] == "file of a library":
    with files.write_whole_file(path) as part:
        part.write_bytes(b"".join(parts()))
else:
    with files.write_whole_folder(path, "model.yaml") as temporary:
        (temporary / "model.yaml").write_bytes(b"".join(parts()))
"""


@pytest.mark.process
@pytest.mark.parametrize("kind", ["file", "file of a library", "folder"])
def test_what_a_killed_writer_left_is_removed_and_what_a_living_one_writes_is_not(
    tmp_path, kind
):
    def hidden():
        return sorted(
            path.name for path in tmp_path.iterdir() if path.name.startswith(".")
        )

    command = [sys.executable, "-c", LEAVING, kind]
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
    killed = subprocess.Popen([*command, str(tmp_path / "one")], **pipes)
    living = subprocess.Popen([*command, str(tmp_path / "two")], **pipes)
    try:
        for writer in (killed, living):
            assert writer.stdout.readline() == b"begun\n"
        assert len(hidden()) == 2
        write_text(tmp_path / "third", "text")
        assert len(hidden()) == 2, "both are at work"
        killed.kill()
        killed.wait()
        write_text(tmp_path / "third", "text")
        assert [name.split(".")[1] for name in hidden()] == ["two"]
        with write_whole_folder(tmp_path / "fourth", MARKER) as temporary:
            fill(temporary)
            assert len(hidden()) == 2
        assert living.communicate(b"", timeout=60) == (b"", None)
        assert living.returncode == 0
    finally:
        for writer in (killed, living):
            writer.kill()
            writer.communicate()
    assert not hidden()
    found = tmp_path / "two" / MARKER if kind == "folder" else tmp_path / "two"
    assert found.read_bytes() == b"halfwhole"


def test_what_somebody_else_hid_is_no_leftover(tmp_path):
    others = (
        ".git",
        ".out.a1b2c3d4",
        ".out.8charact",
        ".x.unfinished",
        ".out.a1b2c3d4.replaced",
    )
    for name in others:
        (tmp_path / name).mkdir()
    (tmp_path / ".out.0123abcd.unfinished").symlink_to(tmp_path / ".git")
    os.mkfifo(tmp_path / ".pipe.0123abcd.unfinished")  # to open one may last for ever
    write_text(tmp_path / "file", "text")
    assert len(os.listdir(tmp_path)) == len(others) + 2


def test_what_the_user_put_into_a_folder_stays_there(old):
    (old / "notes").mkdir()
    (old / "notes" / "mine.md").write_text("years of work")
    (old / "notes" / "link").symlink_to("mine.md")
    (old / "empty").mkdir()
    (old / "script.sh").write_text("echo")
    (old / "script.sh").chmod(0o750)
    with write_whole_folder(
        old, MARKER, {MARKER, "extra", "sub/deep"}.__contains__
    ) as temporary:
        fill(temporary)
    assert tree(old) == {
        MARKER: b"new",
        "notes/link": b"years of work",
        "notes/mine.md": b"years of work",
        "script.sh": b"echo",
        "sub/deep": b"deep",
    }
    assert (old / "notes" / "link").is_symlink()
    assert (old / "empty").is_dir()
    assert (old / "script.sh").stat().st_mode & 0o777 == 0o750


NAMES = ("model.yaml", "sub/deep")


@pytest.fixture
def listed(tmp_path):
    """A folder with a manifest."""
    write_text(tmp_path / "model.yaml", "a: 1\n")
    write_text(tmp_path / "sub" / "deep", "deep")
    write_sums(tmp_path)
    return tmp_path


def test_a_manifest_is_that_of_sha256sum(listed):
    check_sums(listed, NAMES)
    by_tool = subprocess.run(
        ["sha256sum", *NAMES], cwd=listed, capture_output=True, check=True
    )
    assert (listed / SUMS).read_bytes() == by_tool.stdout
    (listed / "notes").write_text("mine")
    check_sums(listed, NAMES)


def test_json_has_null_for_numbers_that_are_not_finite():
    text = files.format_json(
        {"nan": float("nan"), "ends": (-float("inf"), 1.5), "at": Path("a")}
    )
    assert text == '{"nan": null, "ends": [null, 1.5], "at": "a"}'


@pytest.mark.parametrize("moment", ["mkdir", "fsync", "replace"])
@pytest.mark.parametrize("error", [Crash, PermissionError(13, "Denied", ".out.9m2t")])
def test_a_failure_leaves_the_old_file_alone_and_names_what_was_asked_for(
    tmp_path, monkeypatch, moment, error
):
    path = tmp_path / "file"
    write_text(path, "größe")

    def fail(*_):
        raise error

    monkeypatch.setattr(os, moment, fail)
    with pytest.raises((Crash, OSError)) as caught:
        write_bytes(path, b"new")
    monkeypatch.undo()
    assert tree(tmp_path) == {"file": "größe".encode()}
    assert getattr(caught.value, "filename", str(path)) == str(path)


@pytest.mark.parametrize("call", [1, 2])
def test_where_folders_can_not_change_places_a_failure_leaves_the_old_one(
    old, monkeypatch, call
):
    before = tree(old.parent)
    rename = os.replace
    calls = []

    def fail(source, target):
        calls.append(source)
        if len(calls) == call:
            raise OSError("no space left on device")
        rename(source, target)

    monkeypatch.setattr(files, "_exchange", lambda *_: False)
    monkeypatch.setattr(files.os, "replace", fail)
    with (
        pytest.raises(OSError, match="no space"),
        write_whole_folder(old, MARKER) as temporary,
    ):
        fill(temporary)
    assert tree(old.parent) == before


@pytest.mark.parametrize(
    ("name", "content", "reason"),
    [
        ("thesis.tex", "years of work", r"contains other files but no 'model\.yaml'"),
        (MARKER, "name: mine", "was not written by this command"),
    ],
)
def test_a_folder_of_somebody_else_is_never_replaced(tmp_path, name, content, reason):
    (tmp_path / name).write_text(content)
    with (
        pytest.raises(ConfigError, match=reason),
        write_whole_folder(tmp_path, MARKER, sign="format: ours"),
    ):
        pass
    assert tree(tmp_path) == {name: content.encode()}


def test_a_place_is_checked_without_making_anything(tmp_path, monkeypatch):
    assert check_folder(tmp_path / "a" / "b", MARKER) == tmp_path / "a" / "b"
    (tmp_path / "file").write_text("mine", encoding="utf-8")
    for place in ("file", "file/b"):
        with pytest.raises(ConfigError, match="is a file, not a folder"):
            check_folder(tmp_path / place, MARKER)
    monkeypatch.setattr(os, "access", lambda path, mode: path != tmp_path)
    with pytest.raises(ConfigError, match=f"{tmp_path} can't be written to"):
        check_folder(tmp_path / "a" / "b", MARKER)
    assert os.listdir(tmp_path) == ["file"]


@pytest.mark.parametrize("name", [SUMS, "sub/deep"])
@pytest.mark.parametrize("what", ["missing", "pipe", "large"])
def test_what_is_no_file_to_read_is_named(listed, name, what):
    path = listed / name
    path.unlink()
    if what == "pipe":
        os.mkfifo(path)
    if what == "large":
        with path.open("wb") as file:
            file.truncate(MOST_BYTES + 1)
    with pytest.raises(ModelError, match=f"{name}: is (missing, or not a|larger than)"):
        check_sums(listed, NAMES)


def test_a_manifest_that_lists_another_file_is_refused_without_reading_it(listed):
    with (listed / SUMS).open("a") as manifest:
        manifest.write(f"{hash_bytes(b'')}  ../../../dev/zero\n")
    with pytest.raises(ModelError, match="names no file of a model; remove it"):
        check_sums(listed, NAMES)


def test_a_finished_folder_takes_the_place_of_the_old_one_behind_a_link_too(old):
    link = old.parent / "latest"
    link.symlink_to("out")
    with write_whole_folder(link, MARKER) as temporary:
        fill(temporary)
        assert tree(old)[MARKER] == b"old"
    assert link.is_symlink()
    assert tree(old) == {MARKER: b"new", "sub/deep": b"deep"}
    assert old.stat().st_mode & 0o777 == 0o755


@pytest.mark.parametrize("error", [Crash, OSError])
def test_an_error_inside_leaves_the_old_folder_and_no_other(old, error):
    before = tree(old.parent)

    def write_half():
        with write_whole_folder(old, MARKER) as temporary:
            fill(temporary)
            raise error

    with pytest.raises(error):
        write_half()
    assert tree(old.parent) == before
    assert os.listdir(old.parent) == ["out"]


def test_any_flipped_bit_and_any_cut_of_what_was_sealed_is_noticed():
    whole = seal(b"content")
    for good in (whole, seal(b""), seal(bytes(3_000_000))):
        file = io.BytesIO(good)
        check_sealed(file)
        assert file.tell() == 0
    number = int.from_bytes(whole, "big")
    damaged = [number ^ 1 << bit for bit in range(8 * len(whole))]
    flipped = [each.to_bytes(len(whole), "big") for each in damaged]
    for bad in (*flipped, *(whole[:cut] for cut in range(len(whole)))):
        with pytest.raises(ValueError, match="checksum"):
            check_sealed(io.BytesIO(bad))


def test_a_changed_file_is_named_and_an_editable_one_may_lose_its_line(listed):
    for name, hint in (("sub/deep", "generate"), ("model.yaml", "if you changed it")):
        sums = (listed / SUMS).read_text().splitlines(keepends=True)
        (listed / name).write_text("changed")
        with pytest.raises(ModelError, match=f"{name}: does not match .*; {hint}"):
            check_sums(listed, NAMES, editable="model.yaml")
        (listed / SUMS).write_text("".join(x for x in sums if name not in x))
        if name == "model.yaml":
            check_sums(listed, NAMES, editable="model.yaml")
        with pytest.raises(ModelError, match=f"{name}: does not match its checksum"):
            check_sums(listed, NAMES, editable="sub/none")
        write_sums(listed)


FULL = """
import resource, sys
from pathlib import Path
from nics_drl_bridge.files import write_bytes
resource.setrlimit(resource.RLIMIT_FSIZE, (1000, 1000))
try:
    write_bytes(Path(sys.argv[1]), bytes(100_000))
except OSError as error:
    print(error.strerror)
"""


@pytest.mark.process
def test_a_disk_that_takes_no_more_leaves_the_old_file_and_no_other(tmp_path):
    path = tmp_path / "file"
    write_bytes(path, b"old")
    run = subprocess.run(
        [sys.executable, "-c", FULL, str(path)], capture_output=True, text=True
    )
    assert run.stdout == "File too large\n", run.stderr
    assert tree(tmp_path) == {"file": b"old"}
