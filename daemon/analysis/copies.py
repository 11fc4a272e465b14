"""Refuses what was given twice: a copy is no second measurement.

What is fitted to it has too narrow intervals, and what is judged on it has the figures of more frames than there are.
"""

import hashlib
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from shearloop.bank.arrays import FloatArray
from shearloop.bank.estimation.values import FrameSeries
from shearloop.daemon.errors import UserError


def check_paths_differ(paths: Sequence[Path]) -> None:
    """Raise UserError for a recording or a folder that is named twice, be it in two ways."""
    known: dict[Path, Path] = {}
    for path in paths:
        first = known.setdefault(path.resolve(), path)
        if first is not path:
            also = "" if first == path else f", once as {first}"
            raise UserError(f"{path} is given twice{also}; name it once: a copy tells nothing new")


def check_no_copies(series: Sequence[tuple[str, FrameSeries]]) -> None:
    """Raise UserError for named series of the same frames, and for slices of which one has the frame of another."""
    known: dict[bytes, str] = {}
    copies = []
    for name, one in series:
        for what, frames in _measured(name, one):
            first = known.setdefault(_digest(frames), what)
            if first is not what:
                copies.append((what, first))
    if copies:
        more = f", and {len(copies) - 1} more are such copies" if len(copies) > 1 else ""
        raise UserError(
            "{} holds exactly what {} does{}; leave copies out: they tell nothing new".format(*copies[0], more)
        )


def _digest(frames: FloatArray) -> bytes:
    return hashlib.sha256(np.ascontiguousarray(frames).data).digest()


def _measured(name: str, series: FrameSeries) -> Iterator[tuple[str, FloatArray]]:
    """Yield what was measured by itself, with its name: each slice, or the whole recording."""
    if series.kind == "raw":
        yield name, series.channels
        return
    for i, (number, frame, diameter) in enumerate(zip(series.t_s, series.channels, series.diameter_mm, strict=True)):
        if np.isfinite(diameter):
            # Those of all cylinders were taken in turn, so that their times are not their numbers.
            nth = np.count_nonzero(series.diameter_mm[: i + 1] == diameter)
            yield f"{name}: slice {nth} of {diameter:g} mm", frame
        else:
            yield f"{name}: Data_Slice_{number:g}.mat", frame
