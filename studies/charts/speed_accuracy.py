"""`shearloop chart speed-accuracy`: latency against torque error, time per cell against model error, and the loop."""

import platform
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np
from matplotlib.axes import Axes

from shearloop.bank.arrays import Float32Array, FloatArray, IntArray
from shearloop.bank.bank_file import Bank
from shearloop.bank.matching import Matcher, ReferenceMatcher, ZeroLagMatcher
from shearloop.bank.mesh import Mesh
from shearloop.bank.pruned_matching import PrunedMatcher, PrunedZeroLagMatcher
from shearloop.estimation import Calibration, FrameSeries, Physics
from shearloop.estimation.bank_estimators import PaperEstimator
from shearloop.estimation.bank_match import NOT_TURNED, BankMatcher, RefinedMatcher
from shearloop.estimation.defaults import LOADED_NM
from shearloop.estimation.estimator_names import EstimatorName
from shearloop.estimation.interval_fit import fit_interval_regressor
from shearloop.estimation.interval_regressor import IntervalRegressor
from shearloop.estimation.ridge import Ridge
from shearloop.studies.charts.chart_data import Split, fitted
from shearloop.studies.charts.forward_methods import CELLS, SolvedForward, forward_methods
from shearloop.studies.charts.simulated_loop import GAIN, LOOPS, TrackingError, tracking_errors
from shearloop.studies.slices.calibration import SliceCalibration
from shearloop.studies.slices.curve import ranked_channels
from shearloop.studies.slices.evaluate import estimate_slices
from shearloop.studies.slices.series import SliceSeries
from shearloop.tools import drawing
from shearloop.tools.drawing import LINES, MARKS, SHADES
from shearloop.tools.estimate_tracks import estimate_series, values_of

_ESTIMATORS: tuple[EstimatorName, ...] = ("bank", "regression", "reconstruction", "motion_regression")
RANKS = (4, 8, 16, 32, 64, 128)
CHANNEL_COUNTS = (8, 16, 32, 64, 128, 272, 512)
_CHUNK = 512
# The number of cells that determine the directions of a low-rank bank.
_ENOUGH_CELLS = 2000


@dataclass(frozen=True, slots=True)
class TorqueMethod:
    """A way to a torque; `run()` returns the later frames' torques (n,) in N·m, NaN if invalid, and ms each."""

    name: str
    family: str
    run: Callable[[], tuple[FloatArray, FloatArray]]


@dataclass(frozen=True, slots=True)
class MeasuredMethod:
    """A method's time and error: the median of the rounds' medians, and the fastest and slowest round."""

    name: str
    family: str
    latency_ms: float
    latency_low_ms: float
    latency_high_ms: float
    rmse_nm: float
    valid_fraction: float


def measure(methods: list[TorqueMethod], truth_nm: FloatArray, rounds: int) -> list[MeasuredMethod]:
    """Run all methods in turn, `rounds` times, so that a busy moment of the machine affects all alike.

    Errors and valid fractions are of the frames with a known truth.
    """
    times: dict[str, list[float]] = {method.name: [] for method in methods}
    torques: dict[str, FloatArray] = {}
    for _ in range(rounds):
        for method in methods:
            torques[method.name], latency_ms = method.run()
            times[method.name].append(float(np.median(latency_ms)))
    known, found = np.isfinite(truth_nm), []
    for method in methods:
        value, own = torques[method.name], times[method.name]
        judged = known & np.isfinite(value)
        if judged.sum() >= 2:
            rmse_nm = float(np.sqrt(((value - truth_nm)[judged] ** 2).mean()))
            latency = float(np.median(own)), min(own), max(own)
            valid_fraction = float(judged.sum() / known.sum())
            found.append(MeasuredMethod(method.name, method.family, *latency, rmse_nm, valid_fraction))
    return found


def estimators(split: Split, physics: Physics, sides: tuple[str, ...]) -> Iterator[TorqueMethod]:
    """Yield the package's estimators on these sides as they run live; print why one cannot be fitted."""
    count = f", {sides[0] if len(sides) == 1 else 'both'}" if not isinstance(split.past, SliceSeries) else ""
    family = "estimator, two fingertips" if len(sides) > 1 else "estimator"

    def run(calibration: Calibration | SliceCalibration) -> tuple[FloatArray, FloatArray]:
        if isinstance(calibration, SliceCalibration) and isinstance(split.future, SliceSeries):
            track = estimate_slices(calibration, split.future, physics.bank)
        elif isinstance(calibration, Calibration):
            # As `evaluate` does: an estimator reads a grip only if it has seen it begin.
            track = estimate_series(calibration, split.whole, physics.bank)
        later = len(split.future.t_s)
        return values_of(track.estimates)[0][-later:], track.latency_ms[-later:]

    for calibration in fitted(split, _ESTIMATORS, physics, sides):
        yield TorqueMethod(f"{calibration.estimator.name}{count}", family, partial(run, calibration))


def matchers(split: Split, bank: Bank) -> list[TorqueMethod]:
    """Return every way to find σ in the bank; the paper's parabola then turns σ into torque."""
    shapes = np.abs(bank.signals[bank.valid])
    shapes /= np.linalg.norm(shapes, axis=1, keepdims=True)
    half, column = shapes.astype(np.float16), bank.sigma_grid[np.nonzero(bank.valid)[1]]

    def best_of(scores: Callable[[Float32Array], Float32Array]) -> Callable[[FloatArray], float]:
        return lambda x: float(column[np.argmax(scores((x / np.linalg.norm(x)).astype(np.float32)))])

    def half_scores(frame: Float32Array) -> Float32Array:
        # The products are float32, for BLAS.
        parts = [half[i : i + _CHUNK].astype(np.float32) @ frame for i in range(0, len(half), _CHUNK)]
        return np.concatenate(parts)

    def compressed_scores(directions: Float32Array, numbers: Float32Array, frame: Float32Array) -> Float32Array:
        return numbers @ (directions @ frame)

    ways: dict[tuple[str, str], Callable[[FloatArray], float]] = {
        ("paper: all lags, reference", "all lags"): partial(matched_sigma, ReferenceMatcher.from_bank(bank)),
        ("all lags, fast and exact", "all lags"): partial(matched_sigma, PrunedMatcher.from_bank(bank)),
        ("zero lag, reference", "zero lag"): partial(matched_sigma, ZeroLagMatcher.from_bank(bank)),
        ("zero lag, fast and exact", "zero lag"): partial(matched_sigma, PrunedZeroLagMatcher.from_bank(bank)),
        ("zero lag, smoothed, sub-grid", "zero lag"): partial(matched_sigma, RefinedMatcher(bank, NOT_TURNED)),
        ("zero lag, float32", "precision"): best_of(partial(np.matmul, shapes)),
        ("zero lag, float16", "precision"): best_of(half_scores),
    }
    basis = np.linalg.svd(shapes[:: max(1, len(shapes) // _ENOUGH_CELLS)], full_matrices=False)[2]
    for rank in RANKS:
        directions = np.ascontiguousarray(basis[:rank])
        scores = partial(compressed_scores, directions, np.ascontiguousarray(shapes @ directions.T))
        ways[f"rank {rank}", "zero lag, bank of rank r"] = best_of(scores)
    return [TorqueMethod(*named, _timed(split, parabola(split, sigma_of))) for named, sigma_of in ways.items()]


def matched_sigma(matcher: Matcher | BankMatcher, difference: FloatArray) -> float:
    """Return the σ in cm of a difference's match."""
    return matcher.match(difference).sigma


def fewer_channels(split: Split) -> Iterator[TorqueMethod]:
    """Yield regressions on the channels that correlate best with the past torque."""
    differences, torque = np.abs(split.past.channels[:, 0]), split.past.torque_at_frames()
    order = ranked_channels(differences, torque)

    def read(reader: IntervalRegressor, channels: IntArray, difference: FloatArray) -> float:
        return reader.predict(difference[channels])[0]

    for count in CHANNEL_COUNTS:
        best = order[:count]
        reader = fit_interval_regressor(differences[:, best], torque, Ridge.fit)
        run = _timed(split, partial(read, reader, best))
        yield TorqueMethod(f"{count} channels", "regression on the best n channels", run)


def parabola(split: Split, sigma_of: Callable[[FloatArray], float]) -> Callable[[FloatArray], float]:
    """Return the torque in N·m of a difference, by the paper's parabola of its σ, fitted to the past slices."""

    def features(difference: FloatArray) -> FloatArray:
        sigma = sigma_of(difference)
        return np.array([sigma, sigma**2])

    past = np.array([features(frame) for frame in np.abs(split.past.channels[:, 0])])
    curve = Ridge.fit_scaled(past, split.past.torque_at_frames(), *PaperEstimator.strengths)
    return lambda difference: float(curve.predict(features(difference)))


def _timed(split: Split, read: Callable[[FloatArray], float]) -> Callable[[], tuple[FloatArray, FloatArray]]:
    frames = np.abs(split.future.channels[:, 0])

    def run() -> tuple[FloatArray, FloatArray]:
        values, times = [], []
        for frame in frames:
            begun = time.perf_counter()
            values.append(read(frame))
            times.append(1e3 * (time.perf_counter() - begun))
        return np.array(values), np.array(times)

    return run


# The largest noise that the loop's identification tolerates.
_LARGEST_LOOP_NOISE_NM = 0.02
# Errors count valid frames only. A method below this fraction of the most valid one stays off the frontier.
_OFTEN_VALID = 0.9
# Fill of a single window's mark, from the smallest noise to the largest.
_FILLS: tuple[Literal["none", "left", "full"], ...] = ("none", "left", "full")
# Families with one varying setting are joined by a line.
_JOINED = {"zero lag, bank of rank r": "rank", "regression on the best n channels": "channels"}


def compare_methods(split: Split, bank: Bank, mesh: Mesh, rounds: int) -> list[MeasuredMethod]:
    """Return every method's time and error on a split; print where none can be judged."""
    physics, sides = Physics(bank, mesh), split.past.sides
    if isinstance(split.past, SliceSeries):
        methods = [*matchers(split, bank), *fewer_channels(split), *estimators(split, physics, sides[:1])]
    else:
        chosen = dict.fromkeys((sides[:1], sides))
        methods = [method for some in chosen for method in estimators(split, physics, some)]
    measured = measure(methods, loaded_truth(split.future), rounds)
    if not measured:
        print(f"{split.title} is left out: no method has two valid estimates of the later loaded frames")
    return measured


def loaded_truth(series: FrameSeries) -> FloatArray:
    """Return the (n,) torque of loaded frames, NaN for the others, which flatter an average."""
    truth_nm = series.torque_at_frames()
    return np.where(np.abs(truth_nm) >= LOADED_NM, truth_nm, np.nan)


def chart(parts: Sequence[Split], bank: Bank, mesh: Mesh, own_mesh: Mesh | None, out: Path, rounds: int) -> list[Path]:
    """Measure, draw and write the chart; the forward methods are timed on the user's `own_mesh` too."""
    compared = [(split, found) for split in parts if (found := compare_methods(split, bank, mesh, rounds))]
    best = [min(method.rmse_nm for method in methods) for _, methods in compared]
    noises = sorted({round(min(rmse, _LARGEST_LOOP_NOISE_NM), 4) for rmse in [*best, _LARGEST_LOOP_NOISE_NM]})
    loop = tracking_errors(noises[:1] + noises[1:][-2:], max(rounds // 2, 1))
    return write(compared, forward_methods(rounds, own_mesh), loop, bank, out)


def write(
    compared: Sequence[tuple[Split, list[MeasuredMethod]]],
    solved: Sequence[SolvedForward],
    loop: Sequence[TrackingError],
    bank: Bank,
    out: Path,
) -> list[Path]:
    """Draw and write the measurements."""
    content = {
        "machine": f"{platform.machine()}, one thread",
        "bank": {"model": bank.model, "shape": list(bank.signals.shape), "identity": bank.identity},
        # The first method is the paper's, where it was run.
        "methods": {
            split.title: [
                asdict(method) | {"latency_ratio": method.latency_ms / methods[0].latency_ms} for method in methods
            ]
            for split, methods in compared
        },
        "forward": [asdict(method) for method in solved],
        "loop": {"gain": GAIN, "runs": [asdict(run) for run in loop]},
    }
    panels = len(compared) + 2
    rows = (panels + 1) // 2
    made = drawing.figure(15, 6.3 * rows)
    axes = made.subplots(rows, 2, squeeze=False).ravel()
    for (split, methods), panel in zip(compared, axes, strict=False):
        _draw_methods(panel, split, methods)
    _draw_forward(axes[len(compared)], solved)
    _draw_loop(axes[len(compared) + 1], loop)
    for panel in axes[panels:]:
        panel.set_axis_off()
    made.suptitle("Speed against accuracy: below and to the left is better", fontsize=14)
    drawing.lay_out(made)
    for (_, methods), panel in zip(compared, axes, strict=False):
        often = often_valid(methods)
        points = [(method.latency_ms, method.rmse_nm, _short(method, i in often)) for i, method in enumerate(methods)]
        drawing.write_names(panel, points)
    named = [
        (method.cell_ms, method.error, f"{method.name}\n{method.triangles} triangles")
        for method in solved
        if method.error
    ]
    drawing.write_names(axes[len(compared)], named)
    return drawing.save(made, content, out, "speed-accuracy")


def _draw_methods(axes: Axes, split: Split, methods: Sequence[MeasuredMethod]) -> None:
    drawing.plain_log(axes)
    often = often_valid(methods)
    costs, errors = ([getattr(methods[i], name) for i in often] for name in ("latency_ms", "rmse_nm"))
    best = [often[i] for i in drawing.draw_frontier(axes, costs, errors, max(method.latency_ms for method in methods))]
    for number, family in enumerate(dict.fromkeys(method.family for method in methods)):
        style = drawing.look(number)
        members = [i for i, method in enumerate(methods) if method.family == family]
        if family in _JOINED:
            joined = style | {"marker": "", "linewidth": 1, "zorder": 1}
            axes.plot([methods[i].latency_ms for i in members], [methods[i].rmse_nm for i in members], **joined)
        for i in members:
            one = methods[i]
            spread = [[one.latency_ms - one.latency_low_ms], [one.latency_high_ms - one.latency_ms]]
            fill = style["color"] if i in best else "white"
            points = style | {"linestyle": "none", "markersize": 8, "elinewidth": 1, "markerfacecolor": fill}
            label = family if i == members[0] else None
            axes.errorbar(one.latency_ms, one.rmse_nm, xerr=spread, zorder=2 + (i in best), label=label, **points)
    loaded = np.count_nonzero(np.isfinite(loaded_truth(split.future)))
    axes.set(
        title=f"{split.title}; {loaded} loaded of {len(split.future.t_s)} later frames",
        xlabel="latency of one frame, ms (one thread; bars: slowest and fastest round)",
        ylabel=f"torque error on loaded frames (≥ {LOADED_NM:g} N·m), RMS, N·m",
    )
    axes.grid(alpha=0.25, which="both")
    # Leave room for the legend below the frontier.
    low, high = min(method.rmse_nm for method in methods), max(method.rmse_nm for method in methods)
    axes.set_ylim(low * (low / high) ** 0.55, high * 1.25)
    axes.legend(fontsize=8, loc="lower right", title="filled: on the frontier", title_fontsize=8, ncols=2)


def often_valid(methods: Sequence[MeasuredMethod]) -> list[int]:
    """Return the numbers of the methods with about as many valid frames as the best one."""
    most = max(method.valid_fraction for method in methods)
    return [i for i, method in enumerate(methods) if method.valid_fraction >= _OFTEN_VALID * most]


def _short(one: MeasuredMethod, is_often_valid: bool) -> str:
    """Return a label, with the valid fraction where it is clearly below the others'."""
    short = one.name.removeprefix("rank ").removesuffix(" channels").replace("zero lag, ", "").replace("all lags, ", "")
    short = short.replace("paper: reference", "paper").replace("fast and exact", "fast").replace(", right", "")
    return short if is_often_valid else f"{short} ({one.valid_fraction:.0%} valid)"


def _draw_forward(axes: Axes, solved: Sequence[SolvedForward]) -> None:
    drawing.plain_log(axes)
    known = [(method.cell_ms, method.error) for method in solved if method.error is not None]
    costs = [cost for cost, _ in known]
    drawing.draw_frontier(axes, costs, [error for _, error in known], max(costs))
    axes.margins(x=0.12, y=0.12)
    for number, family in enumerate(dict.fromkeys(method.family for method in solved)):
        style = drawing.look(number)
        members = [method for method in solved if method.family == family]
        placed = sorted((method.cell_ms, method.error) for method in members if method.error is not None)
        if placed:
            fill = "white" if members[0].cited else style["color"]
            points = style | {"linewidth": 1, "markersize": 8, "markerfacecolor": fill}
            axes.plot(*zip(*placed, strict=True), label=family, **points)
        for method in members:
            if method.error is None:
                label = f"{method.name}, {method.triangles} triangles"
                axes.axvline(method.cell_ms, label=label, **style | {"marker": ""})
    axes.set(
        title=f"Forward methods, {len(CELLS)} cells of the Gaussian derivative",
        xlabel="time per cell, ms (one thread; cited ones from elsewhere)",
        ylabel="error of the difference signal to a converged mesh, relative L2",
    )
    axes.grid(alpha=0.25, which="both")
    axes.legend(fontsize=7.5, loc="upper right")


def _draw_loop(axes: Axes, loop: Sequence[TrackingError]) -> None:
    axes.set(yscale="log")
    noises = sorted({run.noise_nm for run in loop})
    for number, name in enumerate(LOOPS):
        for noise, line, fill in zip(noises, LINES, _FILLS, strict=False):
            runs = [run for run in loop if run.loop == name and run.noise_nm == noise]
            rms = [run.rms_nm for run in runs]
            bars = [[run.rms_nm - run.rms_low_nm for run in runs], [run.rms_high_nm - run.rms_nm for run in runs]]
            # A single point has no line: its fill shows the noise.
            axes.errorbar(
                [run.delay_s for run in runs], rms, yerr=bars, marker=MARKS[number], color=SHADES[number],
                linestyle=line if len(runs) > 1 else "none", linewidth=1.2, elinewidth=0.7,
                markersize=6 if len(runs) > 1 else 8, fillstyle="full" if len(runs) > 1 else fill,
                markerfacecoloralt="white", zorder=3 if len(runs) == 1 else 2,
                label=f"{name}, noise {1e3 * noise:g} mN·m",
            )  # fmt: skip
            least = rms.index(min(rms))
            if len(runs) > 1:
                axes.plot(
                    runs[least].delay_s, rms[least], "o", markersize=14, markerfacecolor="none", color=SHADES[number],
                )  # fmt: skip
    axes.set_ylim(top=0.5)
    frames = {run.frames: run.delay_s for run in loop}
    top = axes.secondary_xaxis("top")
    top.set_xticks(list(frames.values()), [str(count) for count in frames], fontsize=8)
    top.set_xlabel("frames averaged")
    axes.set(
        title="The loop on a wandering set point (ring: the best window)",
        xlabel="delay of the averaged torque, s", ylabel="tracking error, RMS of torque − set point, N·m",
    )  # fmt: skip
    axes.grid(alpha=0.25, which="both")
    axes.legend(fontsize=7.5, handlelength=3.5, loc="upper left")
