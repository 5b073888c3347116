"""Notes on an identification: the sentences on all findings, in the order of a report."""

from collections.abc import Iterator
from dataclasses import replace

from nics_drl_bridge.identify import followers, verdict
from nics_drl_bridge.identify.acceptance import shortfall
from nics_drl_bridge.identify.by_recording import about_recordings
from nics_drl_bridge.identify.drive import Drive
from nics_drl_bridge.identify.findings import (
    Findings,
    require_fit,
    require_model,
    require_samples,
)


def collect_notes(drive: Drive, findings: Findings) -> tuple[str, ...]:
    """Collects all sentences on a drive and its model, the most serious first."""
    fit = require_fit(findings)
    model = require_model(findings)
    spec = drive.spec
    calibration = findings.calibration
    beaten = [findings.replacement]
    if not findings.replacement:
        beaten = list(shortfall(findings.judgement))
    doubts: Iterator[str] = iter(())
    if findings.motion_width_s is None:
        doubts = verdict.list_doubts_of_fit(fit, calibration.is_exact)
    levels = verdict.count_levels(findings.training.recording.command, spec)
    return (
        *about_recordings(model, calibration, findings.whole),
        *beaten,
        *_explain_replacement(drive, findings),
        *drive.recording.repairs,
        *findings.repairs,
        *verdict.describe_gaps(findings.whole),
        *collect_calibration_notes(findings),
        *findings.refinement,
        *verdict.describe_mirror_image(require_samples(findings), spec, calibration),
        *verdict.describe_unlearnt(fit, calibration, spec, levels),
        *doubts,
        *verdict.describe_untried(drive, findings.held_out, findings.judgement),
        *findings.assumptions,
    )


def collect_calibration_notes(findings: Findings) -> tuple[str, ...]:
    """Collects the sentences on stamps, clocks, mounting and responses."""
    training = findings.training
    calibration = findings.calibration
    if findings.replacement:
        # The latency is that of the fitted textbook, as are mounting and lags, which it explains.
        calibration = replace(calibration, command_latency_s=findings.timing.latency)
        return (
            *verdict.describe_stamps(training),
            *verdict.describe_clocks(training, calibration, findings.timing),
        )
    return (
        *verdict.describe_stamps(training),
        *verdict.describe_clocks(training, calibration, findings.timing),
        *followers.about_sums(calibration),
        *verdict.describe_mounting(training, calibration, findings.mounting),
        *verdict.describe_responses(training, calibration, findings.timing),
    )


def list_plain_calibration_notes(findings: Findings) -> tuple[str, ...]:
    """Returns these sentences as plain strings for a file, which has no kinds of sentences."""
    return tuple(map(str, collect_calibration_notes(findings)))


def _explain_replacement(drive: Drive, findings: Findings) -> Iterator[str]:
    """Yields a sentence if a coarse sampling rate explains why a model lost to its textbook."""
    if not findings.replacement or drive.recording.state is None:
        return
    whole = findings.whole
    unmoved = require_fit(findings).unmoved
    coarse = verdict.describe_coarsest_state(whole.recording, whole.spec, unmoved)
    if coarse:
        yield verdict.Gap(f"{coarse}.")
