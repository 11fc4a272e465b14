"""The loop that holds a shear force on the emulated skin, through friction: limit cycle and offset over gain and delay.

The daemon's own loop (identification, controller, estimator) loads 1 N, unloads to 0.6 N and loads again, in virtual
time. The width of the true force over each hold's end is compared with 2 μFₙ, the width of friction's own band.
"""

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from importlib import resources
from itertools import pairwise
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from shearloop.daemon.control.control_loop import ControlLoop, Drive
from shearloop.daemon.control.experiment import ExperimentPhase
from shearloop.daemon.control.experiment_schema import ExperimentFile, TareStep
from shearloop.daemon.control.inputs import ArmStatus
from shearloop.daemon.loop_config import LoopConfig
from shearloop.daemon.sensing.skin_estimator import SkinEstimator
from shearloop.daemon.sensing.skin_task import SKIN, skin_torque
from shearloop.daemon.torques import TorqueSample, TorqueSource
from shearloop.drivers.shear_skin.skin import SkinSample
from shearloop.emulators.synthetic_skin import SyntheticSkin
from shearloop.estimation.skin.calibration import SkinCalibration, load_calibration
from shearloop.tools.drawing import figure, look, save
from shearloop.tools.parallel import Executor

TICK_S, SAMPLE_TICKS = 0.008, 12.5
# From the middle of a conversion to the controller; and from a speed command to the wrist.
AGE_S, ACTUATION_TICKS = 0.06, 2
# At 0.25 s a reading is stale and the loop holds.
AGES_S = (0.02, 0.06, 0.1, 0.15, 0.2)
RADIUS_MM, SET_POINTS_N = 15.0, (1.0, 0.6, 1.0)
# The judged fraction of each hold, at its end.
SETTLED_FRACTION = 0.6
# Noise of one resistance, as in the emulated DAQ: 1.6 mN of shear force over both gauges.
RELATIVE_NOISE = 0.0016 * 0.088 / 2**0.5
CALIBRATION = Path(str(resources.files("shearloop"))) / "config" / "calibrations" / "skin_demo.yaml"
SOURCE = TorqueSource(name=SKIN, period_s=SAMPLE_TICKS * TICK_S, has_friction_band=True)


@dataclass(frozen=True, slots=True, kw_only=True)
class SkinLoopCase:
    """One run: gain, deadband, and the true and the configured normal force."""

    name: str
    kp: float = 0.5
    normal_n: float = 1.0
    configured_n: float | None = None
    deadband_nm: float = 0.0003
    # Whether the estimator removes friction, and whether the loop gets the band that friction leaves.
    knows_friction: bool = True
    band: bool = True
    age_s: float = AGE_S
    seed: int = 0
    hold_s: float = 20.0


@dataclass(frozen=True, slots=True)
class SkinHold:
    """The result in N: the widest remaining oscillation, and the largest mean distance from a set point."""

    case: SkinLoopCase
    width_n: float
    offset_n: float
    bound_n: float
    phase: str


@dataclass(slots=True)
class SkinTrace:
    """Shear forces in N, a row per tick; the estimates end with the latest known one."""

    truth_n: list[float] = field(default_factory=list)
    estimate_n: list[float] = field(default_factory=list)
    set_point_n: list[float] = field(default_factory=list)


class SkinLoop:
    """The daemon's loop around the emulated skin, tick by tick in virtual time."""

    def __init__(self, case: SkinLoopCase, calibration: SkinCalibration) -> None:
        """Put the tool on the skin, at rest."""
        self._random = np.random.default_rng(case.seed)
        self.skin = SyntheticSkin(radius_mm=RADIUS_MM, normal_n=case.normal_n, seed=case.seed)
        configured_n = case.normal_n if case.configured_n is None else case.configured_n
        if not case.knows_friction:
            calibration = calibration.model_copy(update={"friction": 0.0})
        self.estimator = SkinEstimator(calibration, normal_n=configured_n, zero_samples=20)
        # The chart looks for the boundary, so every margin is allowed.
        config = LoopConfig(
            kp=case.kp, deadband_nm=case.deadband_nm, max_innovation_nm=0.006, max_offset_drift_nm=0.006,
            gain_margin=1.0, phase_margin_deg=0.0,
        )  # fmt: skip
        self._case = case
        self.control_loop = ControlLoop(config, {SKIN: replace(SOURCE, has_friction_band=case.band)}, ())
        self._speeds = deque([0.0] * ACTUATION_TICKS)
        self._angle_rad = 0.0
        self._tick = self._samples = 0
        self._due: list[tuple[int, TorqueSample]] = []
        self._zero_begun = False
        self.trace = SkinTrace()

    @property
    def t_ns(self) -> int:
        """The virtual time."""
        return round(self._tick * TICK_S * 1e9)

    def run(self, most_s: float) -> str:
        """Run the experiment to its end; return how it ended."""
        for _ in range(50):
            self._step()
        why = self.control_loop.start(_experiment(self._case.hold_s), self.t_ns)
        experiment = self.control_loop.experiment
        if experiment is None:
            raise RuntimeError(why)
        while experiment.running and self._tick * TICK_S < most_s:
            self._step()
        phase = experiment.phase
        return phase.value if phase is ExperimentPhase.DONE else f"{phase.value}: {experiment.stop_reason}"

    def _step(self) -> None:
        self._tick += 1
        self._angle_rad += self._speeds.popleft() * TICK_S
        self.skin.turn(self._angle_rad)
        if self._tick * TICK_S >= self._samples * SOURCE.period_s:
            self._samples += 1
            self._measure()
        while self._due and self._due[0][0] <= self.t_ns:
            self.control_loop.on_torque(self._due.pop(0)[1])
            if self._zero_begun and self.estimator.zero is not None:
                self._zero_begun = False
                self.control_loop.on_action_ended()
        self.control_loop.on_arm(ArmStatus(self._angle_rad, self.t_ns))
        speed_rad_per_s = 0.0
        output = self.control_loop.tick(self.t_ns, sent_rad_per_s=self._speeds[-1])
        if isinstance(output, Drive):
            speed_rad_per_s = output.rad_per_s
            if isinstance(output.action, TareStep):
                self.estimator.tare()
                self._zero_begun = True
        self._speeds.append(speed_rad_per_s)
        controller = self.control_loop.wrist.controller
        wanted_nm = controller.set_point_nm if controller is not None else None
        self.trace.truth_n.append(self.skin.shear_n)
        self.trace.set_point_n.append(math.nan if wanted_nm is None else wanted_nm / RADIUS_MM * 1e3)

    def _measure(self) -> None:
        self.skin.rest(SOURCE.period_s)
        noise = self._random.normal(0.0, RELATIVE_NOISE, 2)
        r1, r2 = (ohm * (1.0 + error) for ohm, error in zip(self.skin.resistances_ohm(), noise, strict=True))
        now_ns, known_ns = self.t_ns, self.t_ns + round(self._case.age_s * 1e9)
        reading = self.estimator.update(SkinSample(r1, r2, now_ns, known_ns, self._samples))
        torque = skin_torque(reading, RADIUS_MM * 1e-3, now_ns, known_ns)
        if not self._case.band:
            torque = replace(torque, low_nm=None, high_nm=None)
        self._due.append((known_ns, torque))
        shear_n = math.nan if reading.shear_n is None else reading.shear_n
        estimates = self.trace.estimate_n
        estimates += [shear_n] * (self._tick - len(estimates))


def _experiment(hold_s: float) -> ExperimentFile:
    holds = [
        {"do": "hold_torque", "torque_nm": n * RADIUS_MM * 1e-3, "ramp_nm_per_s": 0.005, "hold_s": hold_s}
        for n in SET_POINTS_N
    ]
    steps = [{"do": "tare"}, {"do": "identify", "amplitude_rad": 0.1}, *holds]
    return ExperimentFile.model_validate(
        {"name": "bench", "torque_source": "skin", "steps": steps, "limits": {"angle_rad": 1}}
    )


def judge(case: SkinLoopCase, calibration: SkinCalibration) -> tuple[SkinHold, SkinTrace]:
    """Run one case; the settled end of each hold is judged."""
    loop = SkinLoop(case, calibration)
    phase = loop.run(200.0)
    bound_n = 2.0 * loop.skin.membrane.belt.friction * case.normal_n
    set_points, truth_n = np.round(loop.trace.set_point_n, 6), np.array(loop.trace.truth_n)
    changes = np.flatnonzero(np.diff(np.nan_to_num(set_points, nan=-1.0))) + 1
    settled = round(SETTLED_FRACTION * case.hold_s / TICK_S)
    ends = pairwise([*changes.tolist(), len(truth_n)])
    found = [truth_n[end - settled : end] for begin, end in ends if np.isfinite(set_points[begin])]
    if phase != ExperimentPhase.DONE.value or len(found) != len(SET_POINTS_N):
        return SkinHold(case, math.nan, math.nan, bound_n, phase), loop.trace
    width_n = max(float(np.ptp(truth)) for truth in found)
    offset_n = max(abs(float(truth.mean()) - wanted) for truth, wanted in zip(found, SET_POINTS_N, strict=True))
    return SkinHold(case, width_n, offset_n, bound_n, phase), loop.trace


# The range of the configuration; at 1 the loop believes each reading fully.
GAINS = (0.05, 0.15, 0.5, 1.0)
NORMALS_N = (0.5, 1.0, 2.0)
SEEDS = 3
KINDS = (
    *(SkinLoopCase(name=f"Fn = {n:g} N", normal_n=n) for n in NORMALS_N),
    SkinLoopCase(name="Fn = 1 N, no deadband", deadband_nm=0.0),
    SkinLoopCase(name="Fn = 2 N, configured as 1 N", normal_n=2.0, configured_n=1.0),
    SkinLoopCase(name="Fn = 1 N, loop without the band", band=False),
    SkinLoopCase(name="Fn = 1 N, friction ignored", knows_friction=False, band=False),
)


def over_gains() -> list[SkinLoopCase]:
    """Return all kinds of cases at all gains."""
    return [replace(kind, kp=kp, seed=10 * seed) for seed, kind in enumerate(KINDS) for kp in GAINS]


def over_delays() -> list[SkinLoopCase]:
    """Return loops with and without the band, at the usual and the highest gain, with ever older readings."""
    return [
        SkinLoopCase(name=f"{'with' if band else 'without'} the band, kp = {kp:g}", band=band, kp=kp, age_s=age_s)
        for band in (True, False)
        for kp in (0.5, 1.0)
        for age_s in AGES_S
    ]


def worst(calibration: SkinCalibration, case: SkinLoopCase) -> SkinHold:
    """Return the widest oscillation and the largest offset over several noises, or the run that broke off."""
    found = [judge(replace(case, seed=case.seed + seed), calibration)[0] for seed in range(SEEDS)]
    broken = [held for held in found if math.isnan(held.width_n)]
    width_n, offset_n = max(held.width_n for held in found), max(held.offset_n for held in found)
    return broken[0] if broken else replace(found[0], width_n=width_n, offset_n=offset_n)


def chart(out: Path, executor: Executor) -> list[Path]:
    """Measure all cases, draw and write `stability-skin`."""
    calibration = load_calibration(CALIBRATION)
    gains, delays = over_gains(), over_delays()
    found = list(executor.map(worst, calibration, [*gains, *delays]))
    shown = judge(SkinLoopCase(name="shown"), calibration)[1]
    made = limit_cycle_figure(found[: len(gains)], found[len(gains) :], shown)
    return save(made, {"held": [asdict(held) for held in found]}, out, "stability-skin")


def limit_cycle_figure(gains: Sequence[SkinHold], delays: Sequence[SkinHold], shown: SkinTrace) -> Figure:
    """Draw one run, then width and offset of all cases over the gain, and the width over the delay."""
    made = figure(12.0, 7.5)
    grid = made.add_gridspec(2, 3, height_ratios=(1.0, 1.3))
    _draw_run(made.add_subplot(grid[0, :]), shown)
    width, distance = "peak to peak / 2 μFn", "mean distance from the set point / 2 μFn"
    panels = (
        ("Limit cycle over the gain", "gain kp", width, gains, "kp", "width_n"),
        ("Accuracy over the gain", "gain kp", distance, gains, "kp", "offset_n"),
        ("Limit cycle over the delay", "age of a reading, s", width, delays, "age_s", "width_n"),
    )
    for column, (title, xlabel, ylabel, held, over, value) in enumerate(panels):
        axes = made.add_subplot(grid[1, column])
        _draw_curves(axes, held, over, value)
        axes.set(title=title, xlabel=xlabel, ylabel=ylabel, ylim=(-0.05, max(1.2, axes.get_ylim()[1])))
        places = GAINS if over == "kp" else AGES_S
        axes.set_xscale("log" if over == "kp" else "linear")
        axes.set_xticks(places, [f"{place:g}" for place in places])
        axes.minorticks_off()
        axes.axhline(1.0, color="black", lw=1, ls=":")
        if value == "width_n":
            axes.axhspan(-0.05, 1.0, color="#55a868", alpha=0.08, lw=0)
            axes.text(0.02, 0.96, "allowed: up to 2 μFn", transform=axes.get_yaxis_transform(), fontsize=8, va="top")
    handles, labels = made.axes[1].get_legend_handles_labels()
    made.legend(handles, labels, loc="outside lower center", ncols=4, fontsize=8)
    made.axes[3].legend(fontsize=8)
    for axes in made.axes:
        axes.grid(alpha=0.25)
    return made


def _draw_run(axes: Axes, shown: SkinTrace) -> None:
    time_s = np.arange(len(shown.truth_n)) * TICK_S
    axes.plot(time_s, shown.truth_n, color="#1f4e79", lw=1.2, label="true shear force")
    axes.plot(time_s[: len(shown.estimate_n)], shown.estimate_n, color="#c44e52", lw=0.9, label="estimate")
    axes.plot(time_s, shown.set_point_n, color="#888888", lw=1, ls="--", label="set point")
    axes.set(
        title="Zero, identification, and three holds (Fn = 1 N, kp = 0.5)", xlabel="time, s", ylabel="shear force, N"
    )
    axes.legend(loc="upper left", fontsize=8)


def _draw_curves(axes: Axes, found: Sequence[SkinHold], over: str, value: str) -> None:
    for number, name in enumerate(dict.fromkeys(held.case.name for held in found)):
        mine = [held for held in found if held.case.name == name]
        style = look(number) | {"markersize": 5, "linewidth": 1.2}
        shares = [getattr(held, value) / held.bound_n for held in mine]
        axes.plot([getattr(held.case, over) for held in mine], shares, label=name, **style)
