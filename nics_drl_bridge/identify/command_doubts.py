"""Doubts that the mapped commands are what was sent to the robot, based on the fit."""

from collections.abc import Iterator, Sequence

from nics_drl_bridge.identify.acceptance import usual
from nics_drl_bridge.identify.calibration import Calibration
from nics_drl_bridge.robot.taylor import HorizonErrors

# ratio to the errors of a constant twist above which commands hardly help
HARDLY = 0.8
LONGEST_S = 1.0  # a longer latency is implausible
EARLIEST_S = -0.2  # a shorter one, too


def doubts_of_commands(
    judgement: Sequence[HorizonErrors], calibration: Calibration
) -> Iterator[str]:
    """Yields a sentence if the commands hardly help to predict, or take effect implausibly late."""
    for at in usual(tuple(judgement)):
        error = at.model.position_m
        without = at.kept_twist.position_m
        if HARDLY * without < error < without:
            ends = f"end {error:.3g} m off after {at.horizon_s:g} s, without them {without:.3g} m"
            yield (
                f"The commands hardly help: predictions by them {ends} (by a constant twist); "
                "check that `command:` names what was sent to the robot."
            )
    latency = calibration.command_latency_s
    if not EARLIEST_S <= latency <= LONGEST_S:
        yield (
            f"A latency of {latency:.2f} s between command and motion is implausible; check that "
            "`command:` names what was sent to the robot, and its `time:`."
        )
