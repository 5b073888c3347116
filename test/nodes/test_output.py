"""A node never waits for whoever reads its output; what does not fit is dropped."""

import contextlib
import os
import pty
import signal
import subprocess
import sys
import termios

import pytest

pytestmark = pytest.mark.process

DEADLINE_S = 30.0
LINES = [*(f"line {k}" for k in range(50)), "over"]
TALKER = """
import os, sys
from nics_drl_bridge.nodes.own_process import leave
from nics_drl_bridge.nodes.own_process import forward_output
forward_output(*sys.argv[2:])
for number in range(int(sys.argv[1])):
    line = f"line {number} {'.' * 80}\\n".encode()
    while line:
        try:
            line = line[os.write(2, line):]
        except BlockingIOError:  # the pipe is full
            break
print("over", flush=True)
leave(3)
"""


FREEZE = """import signal
from nics_drl_bridge.nodes import own_process
own_process._forwarders[0].send_signal(signal.SIGSTOP)
for number in"""


def start(code, *words, **outputs):
    return subprocess.Popen([sys.executable, "-c", code, *words], **outputs)


def full_pipe():
    """Return a pipe that is full."""
    exit_, entrance = os.pipe()
    os.set_blocking(entrance, False)
    with contextlib.suppress(BlockingIOError):
        while True:
            os.write(entrance, b"." * 4095 + b"\n")
    os.set_blocking(entrance, True)
    return exit_, entrance


def read_all(descriptor):
    """Return what can be read until the other side is closed."""
    text = b""
    while True:
        try:
            part = os.read(descriptor, 65536)
        except OSError:  # of a terminal that was closed
            return text.decode()
        if not part:
            return text.decode()
        text += part


def test_all_lines_arrive_in_order_where_somebody_reads_them():
    talker = start(TALKER, "50", stdout=subprocess.PIPE, stderr=subprocess.STDOUT)
    lines = talker.communicate(timeout=DEADLINE_S)[0].decode().splitlines()
    assert [line.split(" .")[0] for line in lines] == LINES
    assert talker.returncode == 3


@pytest.mark.parametrize("closed", [1, 2])
def test_a_closed_output_is_no_error(closed):
    command = [sys.executable, "-c", TALKER, "5"]
    done = subprocess.run(
        ["sh", "-c", f'exec "$@" {closed}>&-', "sh", *command], timeout=DEADLINE_S
    )
    assert done.returncode == 3


def test_a_pipe_that_nobody_reads_delays_nothing():
    count = 30_000
    exit_, entrance = os.pipe()
    talker = start(TALKER, str(count), stdout=entrance, stderr=entrance)
    os.close(entrance)
    assert talker.wait(DEADLINE_S) == 3
    lines = read_all(exit_).splitlines()
    os.close(exit_)
    assert lines[0].startswith("line 0 ")
    assert 1_000 < len(lines) < count


@contextlib.contextmanager
def halted_terminal():
    master, slave = pty.openpty()
    termios.tcflow(slave, termios.TCOOFF)  # as Ctrl-S
    yield slave
    os.close(slave)
    os.close(master)


@pytest.mark.parametrize("hanging", ["terminal", "log file", "forwarder"])
def test_what_hangs_delays_nothing(tmp_path, hanging):
    os.mkfifo(tmp_path / "file")  # nobody opens it for reading
    words = [str(tmp_path / "file")] if hanging == "log file" else []
    code = TALKER
    if hanging == "forwarder":
        code = code.replace("for number in", FREEZE, 1)
        code = code.replace("leave(3)", "own_process._forwarders[0].kill();leave(3)")
    with halted_terminal() as terminal:
        output = terminal if hanging == "terminal" else subprocess.DEVNULL
        talker = start(code, "30000", *words, stdout=output, stderr=output)
        assert talker.wait(DEADLINE_S) == 3
    if words:
        with open(words[0], "rb"):  # `tee` opens it too, and ends
            pass


def test_all_lines_are_in_the_log_file_though_who_read_the_output_has_gone(tmp_path):
    exit_, entrance = os.pipe()
    os.close(exit_)
    talker = start(
        TALKER, "50", str(tmp_path / "log" / "file"), stdout=entrance, stderr=entrance
    )
    os.close(entrance)
    assert talker.wait(DEADLINE_S) == 3
    lines = (tmp_path / "log" / "file").read_text().splitlines()
    assert [line.split(" .")[0] for line in lines] == LINES


ERRORS = """
import os, sys
from nics_drl_bridge.nodes.own_process import forward_errors
with forward_errors():
    for number in range(30_000):
        print("line", number, "x" * 80, file=sys.stderr)
        if number == 0:
            os.write(2, b"of a library\\n")
    print("over", file=sys.stderr)
print("after", flush=True)
os._exit(3)
"""


def test_a_command_that_moves_a_robot_never_waits_for_who_reads_its_errors():
    exit_, entrance = full_pipe()
    command = start(ERRORS, stdout=subprocess.PIPE, stderr=entrance)
    os.close(entrance)
    assert command.communicate(timeout=DEADLINE_S)[0] == b"after\n"
    assert command.returncode == 3
    os.close(exit_)


def test_the_errors_of_a_command_arrive_in_order_and_stderr_is_its_own_again():
    code = ERRORS.replace("30_000", "3")
    code = code.replace("os._exit", "os.write(2, b'own');os._exit")
    command = start(code, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    told, errors = command.communicate(timeout=DEADLINE_S)
    lines = [line.split(" x")[0] for line in errors.decode().splitlines()]
    assert lines == ["line 0", "of a library", "line 1", "line 2", "over", "own"]
    assert told == b"after\n"


@pytest.mark.ros
def test_a_gate_whose_log_nobody_reads_controls_on_and_leaves_a_zero_at_its_end(
    domain_id, model, tmp_path
):
    pytest.importorskip("rclpy", reason="needs ROS 2: rclpy is not installed")
    from nics_drl_bridge.nodes.faulty_robot import Robot

    exit_, entrance = full_pipe()
    given = ("model:=ackermann", "limits:=ackermann", "enable_stamped_cmd_vel:=false")
    words = [*given, "stop_when_held:=false", f"black_box:={tmp_path}"]
    command = [sys.executable, "-m", "nics_drl_bridge.nodes.start", "command_gate"]
    gate = subprocess.Popen(
        [*command, "--ros-args", *(part for word in words for part in ("-p", word))],
        env=os.environ
        | {"ROS_DOMAIN_ID": str(domain_id), "ROS_LOG_DIR": str(tmp_path / "log")},
        stdin=subprocess.DEVNULL,
        stdout=entrance,
        stderr=entrance,
        preexec_fn=lambda: signal.signal(signal.SIGHUP, signal.SIG_DFL),
    )
    os.close(entrance)
    with contextlib.ExitStack() as ends:
        ends.callback(gate.kill)
        robot = Robot(domain_id, model, [0.5, 0.0, 0.0])
        ends.callback(robot.close)
        robot.drive()
        robot.press()
        assert robot.until(lambda: not robot.moves, 5.0)
        robot.drive()
        gate.send_signal(signal.SIGHUP)
        assert robot.until(lambda: gate.poll() is not None, 10.0)
        assert gate.returncode == 0
        assert robot.until(lambda: not robot.moves, 5.0)
    told = read_all(exit_)
    os.close(exit_)
    (log,) = (tmp_path / "log").iterdir()
    assert log.name.startswith("command_gate_")
    for text in (told, log.read_text()):
        assert "[command_gate]: running" in text
        assert "stopped by e_stop_pressed" in text
