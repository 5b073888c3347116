"""The fit report: what a model says, how well it fits, and what it could not learn."""

from __future__ import annotations

from textwrap import fill

from nics_drl_bridge.calibration.identify import Identified
from nics_drl_bridge.calibration.open_loop import OpenLoop
from nics_drl_bridge.kinematics.spec import RobotSpec

WIDTH = 96


def fit_report(source: str, spec: RobotSpec, identified: Identified) -> str:
    """The report as text for people.

    Args:
        source: where the recording came from.
        spec: the robot.
        identified: all that was learnt.
    """
    model = identified.model
    lines = [
        f"Fit report: robot {spec.name!r} from {source}",
        "",
        f"Kept {model.terms_kept} of {identified.fit.terms_total} terms, step {model.dt:g} s "
        f"(X = {', '.join(model.variables)}):",
        *(f"  {equation}" for equation in model.equations()),
        "",
        "Error of the linear fit per degree of freedom, on the part it was fitted to:",
        *_errors(identified),
        "",
        f"Open loop, on data held out from the fit (after {identified.train_until_s:.1f} s):",
        *_open_loop(identified.held_out),
        "",
        "Found, and not learnt:",
        *(_item(note) for note in identified.notes or ("Nothing had to be corrected.",)),
    ]
    return "\n".join(lines) + "\n"


def _item(note: str) -> str:
    return fill(note, WIDTH, initial_indent="  - ", subsequent_indent="    ")


def _errors(identified: Identified) -> list[str]:
    fit, model = identified.fit, identified.model
    return [
        f"  {dof:<24} RMSE {rmse:.3g} {unit}, R2 {r2:.6f}"
        for dof, unit, rmse, r2 in zip(model.dofs, model.dof_units, fit.rmse, fit.r2, strict=True)
    ]


def _open_loop(held_out: OpenLoop | None) -> list[str]:
    if held_out is None:
        return ["  the drive is too short to hold data out"]
    return [
        f"  after {held_out.horizon_s:g} s: position error {held_out.mean_position_error_m:.3g} m "
        f"on average, {held_out.max_position_error_m:.3g} m at most,",
        f"  heading error {held_out.mean_heading_error_rad:.3g} rad on average, over a mean path "
        f"of {held_out.mean_path_m:.2f} m ({held_out.windows} windows)",
    ]
