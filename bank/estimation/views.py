"""Ordinary frames, looked at in a few compiled calls: all is usable of them, or as much as of those before them.

What depends on which channels are usable is made once for these, and not for each frame. Without a compiler there is
nothing here, and NumPy goes the long way (`Memory`), as it does with every other frame.
"""

from collections.abc import Callable
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from shearloop.bank.eit.channels import N_CHANNELS
from shearloop.bank.estimation.values import BoolArray, FloatArray, everywhere

if TYPE_CHECKING:
    from shearloop.bank.eit._frames import Fingertips


class Look(NamedTuple):
    """What an ordinary frame looks like: (m, 896) channels with unusable ones filled in, which are usable, which lost.

    And the share of each side's usable channels that jump.
    """

    channels: FloatArray
    usable: BoolArray
    lost: BoolArray
    jumping_shares: list[float]


class Placed(NamedTuple):
    """Where a frame lies: the score of each side's grip, and the (m, 896) difference to the idle frame.

    At the calibration's gain, as are the (m·p,) places of the frame and of its difference along the directions.
    """

    grips: list[float]
    difference: FloatArray
    place: FloatArray
    from_idle: FloatArray


class _View:
    """What looks at frames while the same (m, 896) channels are told to be usable, and the same are lost."""

    def __init__(self, fingertips: "Fingertips", told: BoolArray, lost: BoolArray) -> None:
        self.fingertips = fingertips
        self.lost = lost
        self.usable: BoolArray = told & ~lost
        self.n_usable: list[int] = np.count_nonzero(self.usable, axis=-1).tolist()
        self.is_whole = everywhere(self.usable)


class Views:
    """What looks at ordinary frames of m fingertips: where all is usable, and where as much is as was lately."""

    def __init__(self, m: int, n_places: int, made_for: Callable[[BoolArray, BoolArray], "Fingertips | None"]) -> None:
        """Take the number of sides, how many places a frame has, and what makes the compiled part.

        It is given which (m, 896) channels are told to be usable and which are lost, and returns None where too little
        is left, and where nothing is compiled.
        """
        self._made_for, self._n_places = made_for, n_places
        nothing = np.zeros((m, N_CHANNELS), dtype=np.bool_)
        self._whole = self._views = self._viewed(~nothing, nothing)
        # The masks of the last frame that was none of these, and those that `_views` were last made for.
        self._last = self._made = (b"", b"")

    def _viewed(self, told: BoolArray, lost: BoolArray) -> tuple[_View, ...]:
        fingertips = self._made_for(told, lost)
        return () if fingertips is None else (_View(fingertips, told, lost),)

    def prepare(self, told: BoolArray, lost: BoolArray) -> None:
        """Take note of the masks of a frame that was not ordinary; those like it are, once these have come twice.

        A dead channel or a lost electrode stays so; what flickers is not worth it.
        """
        if not self._whole or (everywhere(told) and not np.count_nonzero(lost)):
            return
        before, self._last = self._last, (told.tobytes(), lost.tobytes())
        if before == self._last != self._made:
            self._made = self._last
            # Kept, whatever becomes of the frame's arrays.
            self._views = (*self._viewed(told.copy(), lost.copy()), *self._whole)

    def look(self, frame: FloatArray, told: BoolArray, lost: BoolArray, before: FloatArray) -> Look | None:
        """Return what an ordinary (m, 896) frame looks like in a call or two; None of others.

        One is ordinary where nothing usable is at a rail, and `Guards.seen` finds no reason against it and nothing lost
        but what was in the frame before; `before` are that one's channels.
        """
        for view in self._views:
            counts = view.fingertips.check(frame, told, lost, before)
            if counts is None:
                continue
            if not view.is_whole:
                frame = frame.copy()
                view.fingertips.fill_in(frame, before)
            shares = [count / n for count, n in zip(counts, view.n_usable, strict=True)]
            return Look(frame, view.usable, view.lost, shares)
        return None

    def place(self, frame: FloatArray, usable: BoolArray, idle: FloatArray, gains: FloatArray) -> Placed | None:
        """Return where a frame lies in one call; None where other channels are usable.

        From an idle frame (m, 896), at gains (m, 1) against the calibration's.
        """
        if not self._views:
            return None
        difference, places = np.empty(frame.shape), np.empty((2, self._n_places))
        for view in self._views:
            grips = view.fingertips.placed(frame, usable, idle, gains, difference, places)
            if grips is not None:
                return Placed(grips, difference, *places)
        return None
