"""Which tool a recording is of: as its notes or its experiment name it, as it is told, or as the gripper felt it."""

import numpy as np
from numpy.typing import NDArray

from shearloop.bank.estimation import Measured
from shearloop.bank.estimation.calibrated import LARGEST_TOOL_SHARE
from shearloop.daemon.errors import UserError
from shearloop.daemon.recording.reader import Recording
from shearloop.daemon.recording.schema import DIAMETER_NOTE, LARGEST_DIAMETER_MM

# A grip that met something on its way, or was taken anew, is no other tool: so much of the time may be of one.
_MOMENTARY = 0.05


def tool_of(
    recording: Recording, t_ns: NDArray[np.int64], told_mm: float | None = None
) -> tuple[float, Measured | None]:
    """Return the diameter of a recording's tool in mm, NaN where nobody named it, and then the gripper's, if it told.

    The recording's own word goes before `told_mm`, and that before what the gripper felt while frames were taken (at
    t_ns, Unix nanoseconds). Raises UserError where the gripper felt several tools, or another than is named, and
    `told_mm` does not say which it was.
    """
    named_mm = _named_mm(recording)
    felt = _felt_mm(recording, t_ns)
    against = ""
    if len(felt) > 1:
        against = f"the gripper held tools of {' and '.join(f'{one.value:.1f}' for one in felt)} mm"
    elif felt and _is_another(felt[0].value, Measured(named_mm, felt[0].half_width)):
        against = f"it names a tool of {named_mm:g} mm, and the gripper held one of {felt[0].value:.1f} mm"
    if against and told_mm is None:
        raise UserError(
            f"{recording.path}: {against}; record one tool at a time, correct the experiment's `tool_mm`, or calibrate "
            "with --tool-mm if you know which it was"
        )
    if told_mm is not None and (against or np.isnan(named_mm)):
        return told_mm, None
    return named_mm, felt[0] if felt and np.isnan(named_mm) else None


def _named_mm(recording: Recording) -> float:
    text = recording.notes.get(DIAMETER_NOTE)
    if text is None:
        return float("nan")
    try:
        value = float(text)
    except ValueError:
        value = float("nan")
    if not 0 < value < LARGEST_DIAMETER_MM:
        raise UserError(f"{recording.path}: the diameter in its notes is {text!r}, and not one in mm; record it again")
    return value


def _felt_mm(recording: Recording, t_ns: NDArray[np.int64]) -> list[Measured]:
    """Return the tool that the gripper held while frames were taken, or two where it was not always the same."""
    if not recording.tools:
        return []
    told = [tool for _, tool in recording.tools]
    at = np.searchsorted([since_ns for since_ns, _ in recording.tools], t_ns, side="right") - 1
    held = [tool for row in at.tolist() if row >= 0 and (tool := told[row]) is not None]
    if not held:
        return []
    usual = sorted(held, key=lambda one: one.value)[len(held) // 2]
    others = [one for one in held if _is_another(one.value, usual)]
    return [usual] if len(others) <= _MOMENTARY * len(held) else [usual, others[len(others) // 2]]


def _is_another(diameter_mm: float, tool: Measured) -> bool:
    return abs(diameter_mm - tool.value) > LARGEST_TOOL_SHARE * tool.value + tool.half_width
