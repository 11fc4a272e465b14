"""The channel table: which electrodes each channel drives and measures, and where it stands in a line.

The one place that knows the order and the sign of the channels. A table's digest goes into every bank, calibration and
recording; files made under another table are refused by name.
"""

import hashlib
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Literal, TypeVar

import numpy as np
from numpy.typing import NDArray

from shearloop.bank.arrays import BoolArray, FloatArray, IntArray
from shearloop.bank.errors import GeometryError

Injection = Literal["opposite", "adjacent"]
# The paper's.
INJECTION: Injection = "opposite"
# In the model's unit of current, as the reference solutions have it.
STIMULATION_CURRENT = 5.0
# Fewer electrodes leave too few pairs that touch no driven electrode; the EIT-kit has no more.
_ELECTRODES = range(8, 33)
_Scalar = TypeVar("_Scalar", bound=np.generic)


@dataclass(frozen=True)
class ChannelTable:
    """The channels of a kind of fingertip: n channels of L electrodes. The default is the paper's, with 896 of 32.

    Injection i drives −I at electrode i and +I at the opposite electrode (Trehan et al. 2025, figure 2d) or at the
    next one. Channel (i, m) is V(m) − V(m+1), m ascending with wrap, without the pairs that touch a driven electrode.
    The board sends all L × L pairs and writes those as exactly 0. Raises GeometryError for a number of electrodes that
    is odd, below 8 or above 32.
    """

    n_electrodes: int = 32
    injection: Injection = INJECTION

    def __post_init__(self) -> None:
        """Check the number of electrodes."""
        if self.n_electrodes not in _ELECTRODES or self.n_electrodes % 2:
            raise GeometryError(
                f"a fingertip has an even number of {_ELECTRODES.start} to {_ELECTRODES.stop - 1} electrodes, not "
                f"{self.n_electrodes}"
            )

    @property
    def n_line_values(self) -> int:
        """Values of a line."""
        return self.n_electrodes**2

    @property
    def n_channels(self) -> int:
        """Channels of a frame."""
        return len(self.line_slots)

    @property
    def description(self) -> str:
        """The kind of fingertip, in words."""
        return f"{self.n_channels} channels of {self.n_electrodes} electrodes with {self.injection} injection"

    @cached_property
    def zero_slots(self) -> BoolArray:
        """(L²,) True at the values of a line with a pair that touches a driven electrode."""
        pairs = self._pairs()
        return _read_only((pairs[:, :2, None] == pairs[:, None, 2:]).any(axis=(1, 2)))

    @cached_property
    def line_slots(self) -> IntArray:
        """(n,) position of each channel among the values of a line."""
        return _read_only(np.flatnonzero(~self.zero_slots))

    @cached_property
    def electrodes(self) -> IntArray:
        """(n, 4) electrodes of each channel: sink (−I), source (+I), positive and negative measuring electrode."""
        return _read_only(self._pairs()[self.line_slots])

    @cached_property
    def twins(self) -> IntArray:
        """(2, n/2) the two channels of each voltage: a frame has every voltage twice.

        An opposite injection comes a second time with its current reversed. Adjacent ones may change places with the
        measuring pair (reciprocity).
        """
        found: dict[frozenset[frozenset[int]], list[int]] = {}
        for channel, (sink, source, positive, negative) in enumerate(self.electrodes.tolist()):
            found.setdefault(frozenset({frozenset({sink, source}), frozenset({positive, negative})}), []).append(
                channel
            )
        return _read_only(np.array(sorted(found.values())).T)

    @cached_property
    def digest(self) -> str:
        """The hash of the table, the same on all machines."""
        rows = np.column_stack([self.line_slots, self.electrodes]).astype("<i4")
        return hashlib.sha256(b"shearloop channel table 1" + rows.tobytes()).hexdigest()

    def channels_of_line(self, values: FloatArray) -> FloatArray:
        """Return the (…, n) channels of (…, L²) line values, in volts and line order."""
        return values[..., self.line_slots]

    def line_of_channels(self, channels: FloatArray) -> FloatArray:
        """Return the (…, L²) line values of (…, n) channels, with exact zeros where the board writes them."""
        values = np.zeros((*channels.shape[:-1], self.n_line_values))
        values[..., self.line_slots] = channels
        return values

    def twin_means(self, differences: FloatArray) -> FloatArray:
        """Return the (…, n/2) means of the magnitudes that (…, n) differences contain twice."""
        first, second = self.twins
        return np.asarray((differences[..., first] + differences[..., second]) / 2)

    def name_dead(self, dead: BoolArray) -> list[str]:
        """Return the electrodes, pairs and currents whose channels are all dead, by (n,) dead channels.

        An electrode measures in two pairs, and drives in two injections, which an opposite one shares with another.
        """
        if dead.all():
            return ["every electrode"]
        named, explained = [], np.zeros(self.n_channels, dtype=np.bool_)
        for name, channels in self._groups:
            if dead[channels].all() and not explained[channels].all():
                named.append(f"{np.count_nonzero(channels)} channels {name}")
                explained |= channels
        return named

    def still_groups(self, still: BoolArray) -> BoolArray:
        """Return the (n,) channels that one contact can silence together, and that are all still by (n,) `still`.

        A single channel may stand still by chance.
        """
        own = [group for _, group in self._groups if still[group].all()]
        return np.any(own, axis=0) if own else np.zeros_like(still)

    @cached_property
    def _groups(self) -> tuple[tuple[str, BoolArray], ...]:
        return tuple(self._list_groups())

    def _list_groups(self) -> Iterator[tuple[str, BoolArray]]:
        """Yield the channels that one contact can silence, with its name, the largest groups first."""
        sink, source, positive, negative = self.electrodes.T
        every = range(self.n_electrodes)
        for electrode in every:
            yield f"of {electrode_name(electrode)}", (positive == electrode) | (negative == electrode)
        for electrode in every:
            driven = (sink == electrode) | (source == electrode)
            # An opposite injection is the only one of both its electrodes.
            shared = sorted({*sink[driven].tolist(), *source[driven].tolist()})
            electrodes = shared if len(shared) == 2 else [electrode]
            yield f"driven through {' and '.join(map(electrode_name, electrodes))}", driven
        for electrode in every:
            pair = electrode_name(electrode), electrode_name((electrode + 1) % self.n_electrodes)
            yield f"between {' and '.join(pair)}", positive == electrode
        for electrode in every:
            own = sink == electrode
            source_name = electrode_name(int(source[own][0]))
            yield f"driven from {source_name} to {electrode_name(electrode)}", own

    def _pairs(self) -> IntArray:
        injection, pair = np.divmod(np.arange(self.n_line_values), self.n_electrodes)
        step = self.n_electrodes // 2 if self.injection == "opposite" else 1
        source, negative = (injection + step) % self.n_electrodes, (pair + 1) % self.n_electrodes
        return np.column_stack([injection, source, pair, negative])


def electrode_name(electrode: int) -> str:
    """Return the name of an electrode, counted from 0 as in a fingertip's file, and of its pin, counted from 1."""
    return f"electrode {electrode} (pin {electrode + 1})"


PAPER_TABLE = ChannelTable()

# The paper's window along the channels: a Gaussian over nine, standard deviation 9/5; less of it at both ends.
_WINDOW = np.exp(-0.5 * (np.arange(-4, 5) / (9 / 5)) ** 2)


def smoothed_along_channels(differences: FloatArray) -> FloatArray:
    """Return (m, n) differences averaged over nine channels, as the paper did with its cylinders (its section 2)."""
    within = np.convolve(np.ones(differences.shape[1]), _WINDOW, "same")
    return np.asarray(np.array([np.convolve(row, _WINDOW, "same") for row in differences]) / within)


def _read_only(array: NDArray[_Scalar]) -> NDArray[_Scalar]:
    array.setflags(write=False)
    return array
