"""Designs a bank for a recording, as the YAML that `bank build` takes."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from shearloop.bank.design import ALLOWED, Design, MeasuredFrames, design_bank
from shearloop.errors import UserError
from shearloop.estimation.defaults import LOADED_NM
from shearloop.estimation.grips import segment_grip
from shearloop.estimation.series import FrameSeries
from shearloop.estimation.validator_fit import channel_noise
from shearloop.tools.bank_config import load_fingertip
from shearloop.tools.banks import OWN_FINGERTIP
from shearloop.tools.frame_series import read_series

# The principal directions of one contact's frames; the rest is noise.
_N_DIRECTIONS = 4
# Beyond √½ less than half of a frame's square is explained. Unexplained are 61 % of the recorded slices, 70 % of
# the right fingertip's twists, 78 % of the left one's, which the lever hardly moves, and 91 % without a grip.
_MAX_UNEXPLAINED = 0.71
# Twice the noise of the recorded slices (16 %; recorded twists 8 and 12 %); without a grip it is 47 %.
_MAX_NOISE = 1.0 / 3.0
_RECORD_A_TWIST = "record a tool that is gripped and twisted"


def designed_for(scene: MeasuredFrames, fingertip: Path | None) -> tuple[Path, Design]:
    """Return the fingertip's file and the design; raises UserError and BankError for unusable files."""
    path = fingertip or OWN_FINGERTIP
    return path, design_bank(load_fingertip(path), scene)


def scene_of_recording(recording: Path, side: str | None) -> MeasuredFrames:
    """Return what a design needs of a recording; raises UserError without a torque."""
    # A named side is read alone, so that gaps of the other do not matter.
    (series,) = read_series(recording, None if side is None else (side,))
    if not series.torque_t_s.size:
        raise no_torque(recording)
    return scene_of(series)


def no_torque(recording: Path) -> UserError:
    """Return the error for a recording without torques."""
    return UserError(f"{recording} holds no torque; a design needs frames of a tool that is twisted")


def scene_of(series: FrameSeries) -> MeasuredFrames:
    """Return the first side's gripped differences, their noise, and the torque."""
    torque = series.torque_at_frames()
    idle, gripped, _ = segment_grip(series)
    frames = series.channels[gripped, 0]
    # A recording that begins gripped has no idle frame: use its first one.
    before = series.channels[idle, 0] if idle.stop > 0 else series.channels[:1, 0]
    noise = channel_noise(frames)
    differences = frames - np.median(before, axis=0)
    # The substitute for the idle frame has no difference.
    used = np.isfinite(torque[gripped]) & differences.any(axis=1)
    return MeasuredFrames(differences[used], float(np.median(noise[np.isfinite(noise)])), torque[gripped][used])


def residual_noise(frames: NDArray[np.float64]) -> float:
    """Return the noise in volts of (n, 896) differences: the residual of their principal directions."""
    s = np.linalg.svd(frames - frames.mean(axis=0), compute_uv=False)
    freedom = max(len(frames) - 1 - _N_DIRECTIONS, 1)
    # An overflowing square is infinite, and the scene refuses it.
    with np.errstate(over="ignore"):
        return float(np.sqrt((s[_N_DIRECTIONS:] ** 2).sum() / freedom / frames.shape[1]))


def design_yaml(design: Design, fingertip: Path, recording: Path) -> str:
    """Return the design as a bank's configuration, with the rest as comments."""
    k, sigma = (
        f"{{low: {low:.4g}, high: {high:.4g}, count: {count.chosen.setting:.0f}}}"
        for (low, high), count in ((design.k_range, design.k_count), (design.sigma_range, design.sigma_count))
    )
    rows = [
        f"# Designed for {recording}: the coarsest that adds at most {ALLOWED:.0%} of its noise, which is",
        f"# {design.relative_noise:.1%} of a difference frame. `shearloop bank build --config` takes this file.",
        *(f"# NOTE: {line}" for line in doubts(design)),
        *(
            f"# {fit.model}: {fit.penalised:.1%} ± {fit.standard_error:.1%} of a frame unexplained on other injections"
            for fit in sorted(design.models, key=lambda fit: fit.penalised)
        ),
        *(f"# {line}" for line in choice_lines(design)),
        f"fingertip: {fingertip.resolve()}",
        f"mesh_size_cm: {design.mesh.chosen.setting:g}",
        f"model: {design.model}",
        f"k: {k}",
        f"sigma: {sigma}",
    ]
    return "\n".join(rows) + "\n"


def doubts(design: Design) -> list[str]:
    """Return reasons not to build a bank of this design, in sentences; empty for frames of a grip."""
    found = []
    least = min(fit.penalised for fit in design.models)
    is_twisted = design.largest_torque_nm is not None and design.largest_torque_nm >= LOADED_NM
    elsewhere = "design for another side, or use an estimator without a bank"
    if least > _MAX_UNEXPLAINED:
        cure = f"the twisted tool changes this fingertip in another way than the models: check --fingertip, {elsewhere}"
        found.append(
            f"even the best model leaves {least:.1%} of a frame unexplained, against 61% of the paper's slices: "
            f"a bank explains less than half of such a frame; {cure if is_twisted else _RECORD_A_TWIST}"
        )
    if design.relative_noise > _MAX_NOISE:
        cure = f"the twisted tool hardly changes this fingertip: grip more firmly, {elsewhere}"
        found.append(
            f"the noise is {design.relative_noise:.1%} of a difference frame, against 16% of the paper's samples: "
            f"it hides the signal; {cure if is_twisted else _RECORD_A_TWIST}"
        )
    return found


def choice_lines(design: Design) -> list[str]:
    """Return each choice with its error and the next finer step's."""
    found = []
    for choice in design.choices:
        step, after = choice.chosen, choice.next_step
        text = f"{choice.name}: {step.setting:g} {choice.unit} ({step.cost}) adds {step.added:.2f} of the noise"
        if not choice.enough:
            text += ", more than a third: the finest tried"
        elif after is not None:
            text += f"; {after.setting:g} would add {after.added:.2f}"
        found.append(text)
    return found
