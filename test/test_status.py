"""What takes long is told in one line, which replaces itself on a terminal."""

import io
from unittest import mock

import pytest

from nics_drl_bridge import kernels
from nics_drl_bridge.status import REPEATED_S, STATUS, UPDATED_S, StatusLine


class Terminal(io.StringIO):
    """A terminal that keeps what was written."""

    def isatty(self) -> bool:
        """Returns True."""
        return True


@pytest.mark.parametrize("file", [Terminal(), io.StringIO()])
def test_texts_replace_each_other_on_a_terminal_only(file: io.StringIO) -> None:
    line = StatusLine()
    with mock.patch("sys.stderr", file):
        line.show("one")
        line.show("two")
        line.clear()
        line.clear()
        interval = line.interval_s
    begin = "nics_drl_bridge: "
    if file.isatty():
        assert file.getvalue() == f"\r\x1b[K{begin}one\r\x1b[K{begin}two\r\x1b[K"
        assert interval == UPDATED_S
    else:
        assert file.getvalue() == f"{begin}one\n{begin}two\n"
        assert interval == REPEATED_S


def test_a_progress_bar_shows_the_texts_instead_while_it_is_there() -> None:
    line = StatusLine()
    shown: list[str] = []
    terminal = Terminal()
    with mock.patch("sys.stderr", terminal):
        with line.shown_by(shown.append):
            line.show("one")
        line.show("two")
    assert shown == ["one"]
    assert "one" not in terminal.getvalue()
    assert "two" in terminal.getvalue()


def test_the_estimate_follows_the_pace_of_the_kernels_so_far() -> None:
    first = kernels.estimate(100, 0, 0.0)
    assert first == "compiling, once on this machine, up to 100 kernels: about 50 s"
    assert "about 200 s" in kernels.estimate(100, 1000, 2000.0).replace("199", "200")
    assert "about 10 s" in kernels.estimate(100, 1000, 100.0)


def test_a_terminal_is_told_again_and_again_and_its_line_is_removed_at_the_end() -> (
    None
):
    terminal = Terminal()
    told = kernels._Compiling()
    told.patience_s = 0.0
    with (
        mock.patch("sys.stderr", terminal),
        mock.patch.object(kernels, "KERNELS", [mock.Mock()]),
    ):
        clock = map(float, range(1000))
        kernels.KERNELS[0].is_warm = False
        with mock.patch.object(kernels.time, "monotonic", side_effect=clock):
            for _ in range(3):
                told.on_start(mock.Mock())
                told.on_end(mock.Mock())
    lines = [part for part in terminal.getvalue().split("\r\x1b[K") if part]
    assert len(lines) == 3
    assert len(set(lines)) > 1  # the estimate has changed
    assert "\n" not in terminal.getvalue()
    assert terminal.getvalue().endswith("\r\x1b[K")
    assert kernels.COMPILING.tell == STATUS.show


def test_the_estimate_ends_with_the_last_kernel_and_never_says_zero() -> None:
    for left in range(4):
        text = kernels.estimate(left, 400, 1.0)
        assert " 0 " not in text
    assert "up to 1 kernel: about 1 s" in kernels.estimate(1, 400, 1.0)
    assert kernels.estimate(0, 400, 1.0).endswith("the last kernels")
