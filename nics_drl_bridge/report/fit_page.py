"""Blocks of a page on a fit: conclusion, then paths and yardsticks, then all figures."""

from collections.abc import Sequence
from pathlib import Path

from nics_drl_bridge.files import write_text
from nics_drl_bridge.identify.identify import Identified
from nics_drl_bridge.identify.judgement import Verdict, select_usual_horizon
from nics_drl_bridge.identify.report import (
    COMPARED,
    HEADS,
    Conclusion,
    conclude,
    format_equations,
    format_error,
    is_share,
    tabulate_judgement,
)
from nics_drl_bridge.report import fit_pictures, html
from nics_drl_bridge.robot.spec import RobotSpec

Blocks = Sequence[str]
Tile = tuple[str, str, bool]


def fit_tile(identified: Identified) -> Tile:
    """Returns the accuracy of a fit as a figure, its meaning, and False if it is doubtful."""
    for at in select_usual_horizon(identified.judgement):
        figure = format_error(at.model, at.path_m)
        yardsticks = {"fitted textbook": at.textbook, "constant twist": at.kept_twist}
        beside = [
            f"{name} {format_error(errors, at.path_m)}"
            for name, errors in yardsticks.items()
            if errors is not None
        ]
        off = "of the path off" if is_share(at.model, at.path_m) else "off"
        meaning = f"{off} after {at.horizon_s:g} s, on unseen data; {', '.join(beside)}"
        return figure, meaning, not conclude(identified).doubts
    return "untested", "on unseen data because the drive is too short", False


def make_verdict_blocks(
    tiles: Sequence[Tile], conclusion: Conclusion, *commands: str
) -> Blocks:
    """Returns figures in large type, doubts, gaps in what was learnt, and what to do next."""
    blocks = [
        html.make_paragraph(f"This model is: {conclusion.verdict}."),
        html.make_tiles(tiles),
    ]
    if conclusion.doubts:
        blocks.append(html.make_bullets(conclusion.doubts))
    if conclusion.gaps:
        blocks += [
            html.make_paragraph("Not learnt from the drive:"),
            html.make_bullets(conclusion.gaps),
        ]
    elif conclusion.verdict is Verdict.GOOD:
        blocks.append(
            html.make_paragraph("The drive shows everything the model needs.")
        )
    blocks.append(html.make_paragraph(conclusion.advice))
    return [*blocks, html.make_code("\n".join(commands))] if commands else blocks


def make_path_blocks(identified: Identified) -> Blocks:
    """Compares predicted with measured paths, and the model's errors with the yardsticks'."""
    if identified.held_out is None or not identified.judgement:
        return [html.make_paragraph("The drive is too short to hold out data.")]
    paths = fit_pictures.draw_held_out_paths(identified.trial)
    caption = "Mean prediction errors on unseen data: those of a good model lie below the others."
    if any(at.band_m for at in identified.judgement):
        caption += " Bars: distances within which 95 % of its predictions should end."
    rows = html.make_table(HEADS, tabulate_judgement(identified.judgement))
    return [
        html.make_picture(paths, "Measured and predicted paths on unseen data."),
        html.make_picture(fit_pictures.draw_yardsticks(identified), caption),
        html.make_details("The same in numbers", [html.make_paragraph(COMPARED), rows]),
    ]


def model_blocks(spec: RobotSpec, identified: Identified, report: str) -> Blocks:
    """Returns the equations and, folded, all figures and pictures of the fit."""
    drawn = fit_pictures.fit_pictures(spec, identified, paths=False)
    pictures = [
        html.make_picture(png, fit_pictures.CAPTIONS[name])
        for name, png in drawn.items()
    ]
    equations = "\n".join(format_equations(identified.model))
    return [
        html.make_code(equations),
        html.make_details("All figures of the fit", [html.make_code(report)]),
        html.make_details("Pictures of the fit", pictures),
    ]


def write_fit_page(
    file: Path, source: str, spec: RobotSpec, identified: Identified, report: str
) -> None:
    """Writes the page of a fit to a recording from `source`, with the fit report as text."""
    conclusion = conclude(identified)
    folder = file.parent
    # The spec may be of a textbook robot with another state.
    spec = identified.drive.spec
    gaps = len(conclusion.gaps)
    model = identified.model
    terms = f"terms of a model with a step of {model.dt:g} s"
    figures = [
        fit_tile(identified),
        (str(gaps), "gaps in the drive's data", not gaps),
        (str(model.terms_kept), terms, True),
    ]
    if model.assumed:
        meaning = "of the terms are assumed from the textbook"
        figures.append((str(len(model.assumed)), meaning, False))
    train = f"nics train --robot {folder} --world arena --seeds 0 --out runs/first"
    commands = (train,) if conclusion.ready else ()
    sections = [
        ("Verdict", make_verdict_blocks(figures, conclusion, *commands)),
        ("Paths", make_path_blocks(identified)),
        ("Model", model_blocks(spec, identified, report)),
    ]
    lead = f"Robot {spec.name!r}, from {source}."
    write_text(file, html.make_page("nics_drl_bridge: fit", lead, sections))
