"""What the design of a bank needs of slices."""

from pathlib import Path

import numpy as np

from shearloop.bank.design import MeasuredFrames
from shearloop.studies.slices.series import SliceSeries, read_slices
from shearloop.tools.bank_design import no_torque, residual_noise


def scene_of_folder(folder: Path, side: str | None) -> MeasuredFrames:
    """Return what a design needs of a folder of slices; raises UserError without a torque."""
    series = [recording for recording in read_slices(folder) if recording.torque_t_s.size]
    if not series:
        raise no_torque(folder)
    return scene_of_slices(series[0] if side is None else series[0].select_sides((side,)))


def scene_of_slices(series: SliceSeries) -> MeasuredFrames:
    """Return the slices, their noise, and the torque where all are known."""
    frames, torque = series.differences, series.torque_at_frames()
    return MeasuredFrames(frames, residual_noise(frames), torque if np.isfinite(torque).all() else None)
