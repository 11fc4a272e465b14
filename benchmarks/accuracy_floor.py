"""The least error that a torque estimate can have on the paper's recordings: a Cramér-Rao bound.

    python -m benchmarks.accuracy_floor RECORDINGS --out FILE

A frame is response · torque + drift + noise. Drift is a random walk along a few directions, fitted to increments of
unloaded frames over one frame and over six. Longer increments contain the gel's relaxation, which is predictable. The
bound is for an unbiased estimate of the last of several unknown torques, after frames of known torque. Response, drift
and noise are known exactly. The load cell's noise, the jitter of its timestamps and the standard error of its delay are
added. RECORDINGS holds torque_slices and streams. First, synthetic frames with a known bound check the calculation.
"""

import math
from pathlib import Path

import numpy as np

from benchmarks.common import parser_of, table_head, table_row, write_figures
from benchmarks.estimator_accuracy import FINGERTIPS, imported_stream
from shearloop.bank.arrays import FloatArray
from shearloop.estimation import FrameSeries
from shearloop.estimation.defaults import LOADED_NM
from shearloop.estimation.grips import segment_grip
from shearloop.estimation.load_delay import find_load_delay
from shearloop.estimation.twists import find_twists
from shearloop.estimation.validator_fit import channel_noise
from shearloop.studies.slices.series import read_slices
from shearloop.tools.frame_series import series_of
from shearloop.tools.recordings.frames import read_recording

# Increments, in frames. The least bound over these numbers of directions counts; each direction needs some increments.
SHORT, LONG = 1, 6
DIRECTIONS, MIN_PER_DIRECTION = (8, 16, 32), 5
# An estimator remembers the first number of frames, with known torques. The second number is a twist of 2.7 s.
KNOWN, UNKNOWN = 13, 5
DEGREES = (1, 2, 3)
# Allowed relative error of the check. Directions fitted to few increments look a little too quiet.
TOLERANCE = 0.15
COLUMNS = ("always 0", "floor", "channels", "load cell", "alignment")
# Standard deviation of normal noise over the median of its absolute values; frames with less torque show the drift.
_MAD, _UNLOADED_NM, _MIN_NOISE_V = 1.4826, 0.002, 1e-5


def bound_nm(response: FloatArray, white: float, drift: FloatArray) -> float:
    """Return the bound in N·m of the last torque, for a response (q,) per N·m, white variance and drift's (q, q)."""
    q, steps = len(response), np.arange(KNOWN + UNKNOWN)
    covariance = np.kron(np.minimum.outer(steps, steps), drift) + white * np.eye(len(steps) * q)
    # The unknowns are the level at the start and the torques.
    torques = np.vstack([np.zeros((KNOWN * q, UNKNOWN)), np.kron(np.eye(UNKNOWN), response[:, None])])
    design = np.hstack([np.tile(np.eye(q), (len(steps), 1)), torques])
    return math.sqrt(np.linalg.inv(design.T @ np.linalg.solve(covariance, design))[-1, -1])


def least_bound_nm(short: FloatArray, long: FloatArray, responses: tuple[FloatArray, FloatArray]) -> float:
    """Return the least bound over the numbers of directions, from increments (n, c).

    `responses` (c,) come from different twists, so that their noise does not count as response.
    """
    first, second = responses
    axes, found = np.linalg.svd(long, full_matrices=False)[2], []
    for k in (one for one in DIRECTIONS if MIN_PER_DIRECTION * one <= len(long)):
        rows = axes[:k]
        at_short, at_long = (rows @ (each.T @ each / len(each)) @ rows.T for each in (short, long))
        white = (float((short**2).sum() / len(short)) - np.trace(at_short)) / (short.shape[1] - k) / 2
        values, vectors = np.linalg.eigh((at_long - at_short) / (LONG - SHORT))
        drift = np.pad(vectors @ np.diag(np.maximum(values, 0.0)) @ vectors.T, (0, 1))
        # White noise is equal in all directions, so the rest of the response counts as one direction.
        left = math.sqrt(max(float(first @ second - (rows @ first) @ (rows @ second)), 0.0))
        found.append(bound_nm(np.append(rows @ (first + second) / 2, left), float(white), drift))
    return min(found)


def twisted_bound_nm(frames: FloatArray, torque_nm: FloatArray) -> float:
    """Return the bound for frames (n, c) in units of noise; some are loaded."""
    loaded = np.abs(torque_nm) >= _UNLOADED_NM
    twists = [rows for rows in find_twists(np.where(loaded, torque_nm, 0.0)) if len(rows) > 2 and rows[0] > 3]
    responses: list[FloatArray] = []
    for half in (twists[::2], twists[1::2]):
        moved = np.vstack([frames[rows] - frames[rows[0] - 3 : rows[0] - 1].mean(axis=0) for rows in half])
        known = torque_nm[np.concatenate(half)]
        responses.append(known @ moved / (known @ known))
    near = np.convolve(loaded, np.ones(3), mode="same") > 0
    starts = {lag: [i for i in range(len(frames) - lag) if not near[i : i + lag + 1].any()] for lag in (SHORT, LONG)}
    short, long = (frames[np.add(starts[lag], lag)] - frames[starts[lag]] for lag in (SHORT, LONG))
    return least_bound_nm(short, long, (responses[0], responses[1]))


def stream_floor_nm(series: FrameSeries, delay_error_s: float) -> dict[str, float]:
    """Return the floor of a stream's loaded frames, its parts, and the error of an estimate that is always 0."""
    grip, torque_nm = segment_grip(series)[1], series.torque_at_frames()
    noise = np.concatenate([channel_noise(series.channels[grip, layer]) for layer in range(len(series.sides))])
    live = np.isfinite(noise) & (noise > 0)
    frames: FloatArray = series.channels[grip].reshape(-1, len(noise))[:, live] / noise[live]
    channels_nm = twisted_bound_nm(frames, torque_nm[grip])
    judged = np.abs(torque_nm) >= LOADED_NM
    rate_nm_per_s = np.sqrt(np.mean(np.gradient(torque_nm, series.t_s)[judged] ** 2))
    load_nm = _MAD * np.median(np.abs(np.diff(series.torque_nm))) / math.sqrt(2)
    stamps_s = math.hypot(_MAD * np.median(np.abs(np.diff(series.torque_t_s, 2))) / math.sqrt(6), delay_error_s)
    zero_nm = float(np.sqrt(np.mean(torque_nm[judged] ** 2)))
    parts = {"channels": channels_nm, "load cell": float(load_nm), "alignment": float(rate_nm_per_s * stamps_s)}
    return {"floor": math.hypot(*parts.values()), **parts, "always 0": zero_nm}


def slices_floor_nm(series: FrameSeries, degree: int) -> float:
    """Return the bound of slices at the root mean square response; channels are polynomials of the torque."""
    torque_nm, frames = series.torque_at_frames(), series.channels[:, 0]
    powers = np.column_stack([torque_nm**d for d in range(1, degree + 1)])
    fitted = np.linalg.lstsq(np.diff(powers, axis=0), np.diff(frames, axis=0), rcond=None)[0]
    left = frames - powers @ fitted
    noise = np.sqrt(np.mean(np.diff(left, axis=0) ** 2, axis=0) / 2).clip(_MIN_NOISE_V)
    slopes = np.column_stack([d * torque_nm ** (d - 1) for d in range(1, degree + 1)]) @ fitted / noise
    short, long = (left[lag:] / noise - left[:-lag] / noise for lag in (SHORT, LONG))
    return float(np.sqrt(np.mean([least_bound_nm(short, long, (one, one)) ** 2 for one in slopes])))


def synthetic_check(seed: int) -> tuple[float, float]:
    """Return the bound found in synthetic twists of known response, drift and noise, and the known one."""
    random, (n, c, k) = np.random.default_rng(seed), (800, 300, 4)
    axes = np.linalg.qr(random.normal(size=(c, k)))[0].T
    response, drift = 100 * (random.normal(size=c) + 40 * axes[0] + 20 * axes[1]), np.diag([9.0, 4.0, 1.0, 0.5])
    torque_nm = np.where(np.arange(n) % 40 >= 35, 0.05, 0.0)
    walk = np.cumsum(random.normal(size=(n, k)) @ np.sqrt(drift), axis=0)
    frames = np.outer(torque_nm, response) + walk @ axes + random.normal(size=(n, c))
    inside = axes @ response
    known = np.append(inside, math.sqrt(response @ response - inside @ inside))
    return twisted_bound_nm(frames, torque_nm), bound_nm(known, 1.0, np.pad(drift, (0, 1)))


def main() -> None:
    """Check, measure, print, write."""
    parser = parser_of(__doc__)
    parser.add_argument("recordings", type=Path, help="folder with torque_slices and streams")
    args = parser.parse_args()
    found_nm, known_nm = synthetic_check(1)
    if abs(found_nm / known_nm - 1) > TOLERANCE:
        raise SystemExit(f"the synthetic frames have a bound of {known_nm:.3g} N·m, and {found_nm:.3g} was found")
    stream = read_recording(imported_stream(args.recordings, "3 December", args.out.parent))
    delay = find_load_delay(series_of(stream))
    chosen = {f"stream, {' and '.join(sides)}": series_of(stream, sides) for sides in FINGERTIPS}
    floors = {name: stream_floor_nm(one, delay.error_s if delay else 0.0) for name, one in chosen.items()}
    (slices,) = read_slices(args.recordings / "torque_slices")
    zero_nm = float(np.sqrt(np.mean(slices.torque_at_frames() ** 2)))
    for degree in DEGREES:
        floor_nm = slices_floor_nm(slices, degree)
        floors[f"slices, response of degree {degree}"] = {"floor": floor_nm, "channels": floor_nm, "always 0": zero_nm}
    print(table_head("loaded frames, N·m", *COLUMNS))
    for name, floor in floors.items():
        print(table_row(name, *(floor.get(column) for column in COLUMNS)))
    write_figures(args.out, floors)


if __name__ == "__main__":
    main()
