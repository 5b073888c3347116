import numpy as np
import pytest
from pydantic import ValidationError

from nics_drl_bridge.robot.curve import InputCurve, apply_curves
from nics_drl_bridge.robot.kernels import apply_curve

CURVE = InputCurve(command="throttle", dead=0.1, least=-0.6, most=0.5, back=0.5)
EAGER = InputCurve(command="throttle", dead=-0.2)
COMMANDS = np.linspace(-1.0, 1.0, 41)


def test_a_motor_stands_in_its_dead_zone_and_saturates():
    assert CURVE.of([-0.1, 0.0, 0.1]) == pytest.approx([0.0, 0.0, 0.0])
    assert CURVE.of([0.3, 0.5, 1.0]) == pytest.approx([0.2, 0.4, 0.4])


def test_backwards_has_a_gain_of_its_own():
    assert CURVE.of([-0.3, -0.6, -1.0]) == pytest.approx([-0.1, -0.25, -0.25])


@pytest.mark.parametrize("curve", [CURVE, EAGER, InputCurve(command="throttle")])
def test_the_kernel_bends_commands_as_the_curve_does(curve):
    row = np.array([curve.dead, curve.least, curve.most, curve.back])
    tried = np.append(COMMANDS, [-np.inf, np.inf])
    assert [apply_curve(value, row) for value in tried] == curve.of(tried).tolist()
    assert np.isnan(apply_curve(np.nan, row))


def test_an_effect_leads_back_to_its_command():
    inside = COMMANDS[
        (np.abs(COMMANDS) > 0.11) & (COMMANDS > -0.59) & (COMMANDS < 0.49)
    ]
    assert CURVE.invert(CURVE.of(inside)) == pytest.approx(inside)
    assert CURVE.invert(CURVE.of([-0.7, 0.8])).tolist() == [-np.inf, np.inf]


def test_a_command_may_do_more_than_in_proportion_but_zero_does_nothing():
    assert EAGER.of([-0.5, 0.0, 0.3]) == pytest.approx([-0.7, 0.0, 0.5])
    assert EAGER.invert([-0.7, 0.0, 0.5]) == pytest.approx([-0.5, 0.0, 0.3])
    assert EAGER.equation == "throttle' = throttle +- 0.2, 0 at 0"


def test_only_the_commands_that_are_named_are_bent():
    moved = apply_curves([[0.3, 0.05]], ("throttle", "steering"), (CURVE,))
    assert moved == pytest.approx(np.array([[0.2, 0.05]]))


def test_a_command_of_zero_never_does_anything():
    assert (
        InputCurve(command="throttle", least=0.2, most=1.0).of([-0.5, 0.0]).tolist()
        == [0.0] * 2
    )


@pytest.mark.parametrize(
    "wrong", [{"dead": np.nan}, {"back": -1.0}, {"most": np.nan}, {"delay": 61.0}]
)
def test_a_curve_that_falls_or_is_late_for_ever_is_refused(wrong):
    with pytest.raises(ValidationError):
        InputCurve(command="throttle", **wrong)
