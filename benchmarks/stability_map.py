"""Where the twist loop becomes unstable: gain over delay and over lost frames, computed and simulated.

    python -m benchmarks.stability_map --out run/stability_map.json

Three loops at the EIT's rate, without noise: one without a delay compensator, the twist controller with the right
stiffness, and the twist controller with a tool twice as stiff as it believes. The simulated boundary is bisected with
the real controller on the simulated plant. The computed one comes from the margins' equations (delay) and
from the monodromy matrix of one cycle of lost frames.
"""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from benchmarks.common import parser_of, write_figures
from shearloop.bank.arrays import FloatArray
from shearloop.daemon.analysis.charts.simulated_loop import (
    LoopController,
    Plant,
    SimulatedSensor,
    SimulatedTool,
    UncompensatedController,
    run,
)
from shearloop.daemon.control.controller import ControllerSettings, TwistController
from shearloop.daemon.control.margins import LoopModel, gain_limit, pulse_response
from shearloop.drivers.eit_kit import FRAME_PERIOD_S

COMMAND_S = 0.016
ACTUATION_S = 0.02
BANDWIDTH_PER_S = 4.0
STIFFNESS = 0.25
# The integral gain is this share of kp², as in the controller.
KI_SHARE = 0.1
EIT_AGE_S = 0.5 * FRAME_PERIOD_S + 0.06
AGES_S = tuple(np.round(np.geomspace(EIT_AGE_S, 3.0, 9), 3))
CYCLE = 8
LOST = tuple(range(7))
LOWEST, HIGHEST = 0.02, 4.0
START_NM = 1e-3
# Long enough to show growth of half a per cent a frame.
FRAMES = 90


@dataclass(frozen=True, slots=True)
class LoopCase:
    """One loop of the map; `stiffness_ratio` is the tool's true stiffness over the assumed one."""

    name: str
    compensated: bool
    stiffness_ratio: float = 1.0

    def model(self, age_s: float, kp: float = 0.1) -> LoopModel:
        """Return the model for the computed boundary."""
        return LoopModel(
            sample_period_s=FRAME_PERIOD_S, window_s=FRAME_PERIOD_S, age_s=age_s, actuation_s=ACTUATION_S,
            wrist_bandwidth_per_s=BANDWIDTH_PER_S, kp=kp, ki=KI_SHARE * kp * kp, command_period_s=COMMAND_S,
            stiffness_ratio=self.stiffness_ratio, compensated=self.compensated,
        )  # fmt: skip

    def controller(self, kp: float) -> LoopController:
        """Return the real controller, without limits."""
        believed, ki = STIFFNESS / self.stiffness_ratio, KI_SHARE * kp * kp
        if not self.compensated:
            return UncompensatedController(
                stiffness_nm_per_rad=believed, kp=kp, ki=ki, wrist_bandwidth_per_s=BANDWIDTH_PER_S
            )
        settings = ControllerSettings(
            stiffness_nm_per_rad=believed, sample_period_s=FRAME_PERIOD_S, window_s=FRAME_PERIOD_S, kp=kp, ki=ki,
            wrist_bandwidth_per_s=BANDWIDTH_PER_S, ramp_nm_per_s=1e3, deadband_nm=0.0, torque_limit_nm=1e3,
            speed_limit_rad_per_s=1e6, acceleration_limit_rad_per_s2=1e9, travel_limit_rad=1e6, age_limit_s=10.0,
            stale_periods=np.inf,
        )  # fmt: skip
        # Enough known measurements for a gain of kp from the start.
        controller = TwistController(settings, 0, 0.0, 0.0, 1e9)
        controller.set_point(0.0)
        return controller


CASES = (
    LoopCase("no compensator", compensated=False),
    LoopCase("twist controller", compensated=True),
    LoopCase("twist controller, tool twice as stiff as believed", compensated=True, stiffness_ratio=2.0),
)


def simulated_boundary(case: LoopCase, age_s: float, lost: int) -> float:
    """Return the gain where a disturbance stops dying out, to half a per cent; inf above HIGHEST."""
    return _bisect(lambda kp: _grows(case, age_s, lost, kp), 1.005)


def computed_boundary(case: LoopCase, age_s: float, lost: int) -> float:
    """Return the gain where the loop's equations become unstable; inf above HIGHEST."""
    if not lost:
        return gain_limit(case.model(age_s), HIGHEST)
    return _bisect(lambda kp: spectral_radius(case, age_s, lost, kp) >= 1.0, 1.0005)


def _bisect(unstable: Callable[[float], bool], ratio: float) -> float:
    if not unstable(HIGHEST):
        return np.inf
    low, high = LOWEST, HIGHEST
    while high > ratio * low:
        middle = float(np.sqrt(low * high))
        low, high = (low, middle) if unstable(middle) else (middle, high)
    return float(np.sqrt(low * high))


def _grows(case: LoopCase, age_s: float, lost: int, kp: float) -> bool:
    sensor = SimulatedSensor(period_s=FRAME_PERIOD_S, window_s=FRAME_PERIOD_S, transfer_s=age_s - 0.5 * FRAME_PERIOD_S)
    tool = SimulatedTool(stiffness_nm_per_rad=STIFFNESS, relaxing_share=0.0, actuation_s=ACTUATION_S)
    plant = Plant(tool, sensor, np.random.default_rng(0), COMMAND_S, disturbance_nm=START_NM)
    frames = FRAMES * CYCLE // (CYCLE - lost) + int(3 * age_s / FRAME_PERIOD_S)
    trace = run(
        plant, case.controller(kp), frames * FRAME_PERIOD_S, lambda number: number % CYCLE < CYCLE - lost,
        bound_nm=100.0 * START_NM,
    )  # fmt: skip
    if abs(trace.torque_nm[-1]) > 100.0 * START_NM:
        return True
    third = len(trace.torque_nm) // 3
    before, after = trace.torque_nm[third : 2 * third], trace.torque_nm[2 * third :]
    return bool(np.abs(after).max() > np.abs(before).max())


def spectral_radius(case: LoopCase, age_s: float, lost: int, kp: float) -> float:
    """Return the spectral radius of the loop over one cycle of received and lost frames (Floquet)."""
    model = case.model(age_s, kp)
    seen = pulse_response(model)[1:]
    received, cycle = _received_frame(case, model, seen), np.eye(seen.size + 2)
    after_loss = _received_frame(case, model, seen, missed=min(lost, 4))
    for number in range(CYCLE):
        frame = _lost_frame(seen.size) if number >= CYCLE - lost else (received if number else after_loss)
        cycle = frame @ cycle
    return float(np.abs(np.linalg.eigvals(cycle)).max())


def _received_frame(case: LoopCase, model: LoopModel, seen: FloatArray, missed: int = 0) -> FloatArray:
    """Return the state matrix of a received frame; the state is (d[k−1] … d[k−n], integral i, correction c).

    Torques are in the controller's scale: a frame shows −(seen · d) times the stiffness ratio.
    """
    size, ratio = seen.size, model.stiffness_ratio
    matrix = _lost_frame(size)
    latest, integral = np.eye(size + 2)[0], np.eye(size + 2)[size]
    shown = -np.append(seen, (0.0, 0.0))
    base = latest + (missed * integral if case.compensated else 0.0)
    excess = (ratio - 1.0) * shown - base if case.compensated else ratio * shown
    matrix[size] = integral + model.ki * excess
    matrix[size + 1] = model.kp * excess + matrix[size]
    matrix[0] = base + matrix[size + 1]
    return matrix


def _lost_frame(size: int) -> FloatArray:
    """Return the state matrix of a lost frame, which changes nothing."""
    matrix = np.zeros((size + 2, size + 2))
    matrix[1:size, : size - 1] = np.eye(size - 1)
    matrix[0, 0] = matrix[size, size] = matrix[size + 1, size + 1] = 1.0
    return matrix


def boundary(case: LoopCase, age_s: float, lost: int) -> dict[str, float | None]:
    """Return the computed and the simulated gain at the boundary, None above HIGHEST."""
    computed, simulated = computed_boundary(case, age_s, lost), simulated_boundary(case, age_s, lost)
    return {
        "age_s": age_s,
        "lost": lost,
        "computed": computed if np.isfinite(computed) else None,
        "simulated": simulated if np.isfinite(simulated) else None,
    }


def worst_disagreement(rows: Iterable[Mapping[str, float | None]]) -> float:
    """Return the largest relative difference of computed and simulated gain; inf where only one is known."""
    worst = 0.0
    for row in rows:
        computed, simulated = row["computed"], row["simulated"]
        if computed is not None and simulated is not None:
            worst = max(worst, abs(simulated / computed - 1.0))
        elif computed is not simulated:
            return np.inf
    return worst


def main() -> None:
    """Measure, write the numbers, draw the chart."""
    parser = parser_of(__doc__)
    args = parser.parse_args()
    points = [(age, 0) for age in AGES_S] + [(EIT_AGE_S, lost) for lost in LOST[1:]]
    found = {case.name: [boundary(case, *point) for point in points] for case in CASES}
    print("| loop | age, s | lost of 8 | computed gain | simulated gain |\n|---|---|---|---|---|")
    for name, rows in found.items():
        for row in rows:
            print(f"| {name} | {' | '.join('–' if value is None else f'{value:.3g}' for value in row.values())} |")
    write_figures(args.out, found)
    print(f"largest disagreement {worst_disagreement([row for rows in found.values() for row in rows]):.1%}")


if __name__ == "__main__":
    main()
