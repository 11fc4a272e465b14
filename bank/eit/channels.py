"""The channel table: which electrodes each of the 896 channels drives and measures, and where it stands in a line.

The one place that knows the order and the sign of the channels. Its hash goes into every bank, calibration and
recording; files made under another table are refused by name.

Opposite injection, adjacent measurement (Trehan et al. 2025, figure 2d): injection i drives −I at electrode i and
+I at electrode i+16; channel (i, m) is V(m) − V(m+1), m ascending with wrap, without the four pairs that touch a
driven electrode. The board sends all 32 × 32 pairs and writes those four as exactly 0.
"""

import hashlib

import numpy as np

from shearloop.bank.arrays import BoolArray, FloatArray, IntArray

N_ELECTRODES = 32
N_CHANNELS = 896
N_LINE_VALUES = N_ELECTRODES * N_ELECTRODES
# In the model's unit of current, as the reference solutions have it.
STIMULATION_CURRENT = 5.0


def _table() -> IntArray:
    injection, pair = np.divmod(np.arange(N_LINE_VALUES), N_ELECTRODES)
    sink, source = injection, (injection + N_ELECTRODES // 2) % N_ELECTRODES
    positive, negative = pair, (pair + 1) % N_ELECTRODES
    return np.column_stack([sink, source, positive, negative])


_ALL_PAIRS = _table()
# True at the 128 values of a line whose pair touches a driven electrode.
ZERO_SLOTS: BoolArray = (_ALL_PAIRS[:, :2, None] == _ALL_PAIRS[:, None, 2:]).any(axis=(1, 2))
# (896,) position of each channel among the 1024 values of a line.
LINE_SLOTS: IntArray = np.flatnonzero(~ZERO_SLOTS)
# (896, 4) electrodes of each channel: sink (−I), source (+I), positive and negative measuring electrode.
CHANNELS: IntArray = _ALL_PAIRS[LINE_SLOTS]
for _array in (ZERO_SLOTS, LINE_SLOTS, CHANNELS):
    _array.setflags(write=False)

CHANNEL_TABLE_HASH = hashlib.sha256(
    b"shearloop channel table 1" + np.column_stack([LINE_SLOTS, CHANNELS]).astype("<i4").tobytes()
).hexdigest()


def channels_of_line(values: FloatArray) -> FloatArray:
    """Return the (…, 896) channels of (…, 1024) line values, in volts and line order."""
    return values[..., LINE_SLOTS]


def line_of_channels(channels: FloatArray) -> FloatArray:
    """Return the (…, 1024) line values of (…, 896) channels, with exact zeros where the board writes them."""
    values = np.zeros((*channels.shape[:-1], N_LINE_VALUES))
    values[..., LINE_SLOTS] = channels
    return values


# The paper's window along the channels: a Gaussian over nine, standard deviation 9/5; less of it at both ends.
_WINDOW = np.exp(-0.5 * (np.arange(-4, 5) / (9 / 5)) ** 2)
_WINDOW_WITHIN = np.convolve(np.ones(N_CHANNELS), _WINDOW, "same")


def smoothed_along_channels(differences: FloatArray) -> FloatArray:
    """Return (n, 896) differences averaged over nine channels, as the paper did with its cylinders (its section 2)."""
    return np.asarray(np.array([np.convolve(row, _WINDOW, "same") for row in differences]) / _WINDOW_WITHIN)
