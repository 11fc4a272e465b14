"""The folder of recordings that a reproduction starts from; either kind of slice may be absent."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from shearloop.bank.eit.channels import channels_of_line
from shearloop.daemon.analysis.reproduce.analysis import FEWEST_SLICES
from shearloop.daemon.errors import UserError
from shearloop.daemon.recording.matlab_streams import (
    DiameterSlices,
    TorqueSlices,
    read_diameter_slices,
    read_line,
    read_torque_slices,
)

TORQUE_FOLDER, DIAMETER_FOLDER = "torque_slices", "diameter_slices"
RAW_FRAME, RAW_HOMOGENEOUS = "TorqueSlice.mat", "TorqueSliceHom.mat"


@dataclass(frozen=True, slots=True, eq=False)
class Inputs:
    """What a folder holds: raw_difference (896,) is of one raw frame; notes say what is absent and so not computed."""

    torque: TorqueSlices | None
    diameter: DiameterSlices | None
    raw_difference: NDArray[np.float64] | None
    notes: tuple[str, ...]


def read_inputs(recordings: Path) -> Inputs:
    """Read torque_slices and diameter_slices of a folder.

    Raises UserError when both are absent, a file cannot be used, or there are fewer than three torque slices.
    """
    torque_folder, diameter_folder = recordings / TORQUE_FOLDER, recordings / DIAMETER_FOLDER
    if not torque_folder.is_dir() and not diameter_folder.is_dir():
        if not recordings.is_dir():
            raise UserError(
                f"{recordings} is no folder; name the one that has {TORQUE_FOLDER} or {DIAMETER_FOLDER} in it"
            )
        raise UserError(f"{recordings} has neither a folder {TORQUE_FOLDER} nor a folder {DIAMETER_FOLDER}")
    notes: list[str] = []
    torque = diameter = raw = None
    if torque_folder.is_dir():
        torque = read_torque_slices(torque_folder)
        if len(torque.torque_nm) < FEWEST_SLICES:
            raise UserError(
                f"{torque_folder} has {len(torque.torque_nm)} slices; a correlation needs at least {FEWEST_SLICES}"
            )
        raw = _raw_difference(torque_folder, notes)
    else:
        notes.append(f"There is no folder {torque_folder}: nothing about torque, and no scores of the models.")
    if diameter_folder.is_dir():
        diameter = read_diameter_slices(diameter_folder)
    else:
        notes.append(f"There is no folder {diameter_folder}: nothing about diameter.")
    return Inputs(torque, diameter, raw, tuple(notes))


def _raw_difference(folder: Path, notes: list[str]) -> NDArray[np.float64] | None:
    frame, homogeneous = folder / RAW_FRAME, folder / RAW_HOMOGENEOUS
    absent = [path.name for path in (frame, homogeneous) if not path.exists()]
    if absent:
        notes.append(f"{' and '.join(absent)} not found in {folder}: models are scored by the matching alone.")
        return None
    return np.abs(channels_of_line(read_line(frame)) - channels_of_line(read_line(homogeneous)))
