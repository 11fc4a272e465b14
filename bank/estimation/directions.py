"""Where values lie along the orthonormal directions of a calibration, by whichever of them are usable."""

import numpy as np

from shearloop.bank.arrays import BoolArray, FloatArray


def coordinates(directions: FloatArray, values: FloatArray, usable: BoolArray) -> FloatArray:
    """Return the (r,) least-squares coordinates of (n,) values along (r, n) orthonormal directions, by the usable."""
    if usable.all():
        # As nearly always: then they are the products.
        return np.asarray(directions @ values)
    return np.asarray(np.linalg.lstsq(directions[:, usable].T, values[usable], rcond=None)[0], dtype=np.float64)
