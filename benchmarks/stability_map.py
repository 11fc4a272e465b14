"""Where the loop becomes unstable: gain × delay and gain × dropped frames, computed and simulated.

    python -m benchmarks.stability_map --out DIR

Four loops at the EIT's rate, without noise: the held speed and the late correction, which have no compensator, and
the twist controller with the right stiffness and with a tool twice as stiff as it believes. The simulated boundary
is bisected with the real controller on the simulated plant; the computed one comes from
`shearloop.daemon.control.margins`
(delay) and from the monodromy matrix of one cycle of dropped frames. Writes stability_map.json and .png.
"""

import argparse
import json
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from benchmarks.alternatives import HeldSpeed, LateCorrection
from benchmarks.closed_loop import Loop, run
from benchmarks.control_charts import draw_stability
from benchmarks.plant import Plant, Sample, Sensor, Tool
from shearloop.bank.arrays import FloatArray
from shearloop.daemon.control.controller import TwistController
from shearloop.daemon.control.margins import LoopModel, gain_limit, pulse_response, window_response
from shearloop.daemon.control.settings import ControllerSettings
from shearloop.drivers.eit_format import FRAME_PERIOD_S

COMMAND_S = 0.016
ACTUATION_S = 0.02
BANDWIDTH_PER_S = 4.0
STIFFNESS = 0.25
# The integral follows the gain as its square, as it does in the controller.
KI_SHARE = 0.1
EIT_AGE_S = 0.5 * FRAME_PERIOD_S + 0.06
AGES_S = tuple(np.round(np.geomspace(EIT_AGE_S, 3.0, 9), 3))
CYCLE = 8
LOST = tuple(range(7))
LOWEST, HIGHEST = 0.02, 4.0
START_NM = 1e-3
# Long enough for what grows by half a per cent a frame to show beside what has died out.
FRAMES = 90


@dataclass(frozen=True, slots=True)
class Case:
    """One loop of the map: whether it has the compensator, and how much stiffer the tool is than it believes."""

    name: str
    compensated: bool
    held_speed: bool = False
    stiffness_ratio: float = 1.0

    def model(self, age_s: float, kp: float = 0.1) -> LoopModel:
        """Return what the margins are computed from."""
        return LoopModel(
            sample_period_s=FRAME_PERIOD_S,
            window_s=FRAME_PERIOD_S,
            age_s=age_s,
            actuation_s=ACTUATION_S,
            wrist_bandwidth_per_s=BANDWIDTH_PER_S,
            kp=kp,
            ki=KI_SHARE * kp * kp,
            command_period_s=COMMAND_S,
            stiffness_ratio=self.stiffness_ratio,
            compensated=self.compensated,
        )

    def loop(self, kp: float) -> Loop:
        """Return the real thing."""
        believed = STIFFNESS / self.stiffness_ratio
        if self.held_speed:
            return HeldSpeed(
                stiffness_nm_per_rad=believed, sample_period_s=FRAME_PERIOD_S, kp=kp, ki=KI_SHARE * kp * kp
            )
        if not self.compensated:
            return LateCorrection(
                stiffness_nm_per_rad=believed, kp=kp, ki=KI_SHARE * kp * kp, wrist_bandwidth_per_s=BANDWIDTH_PER_S
            )
        settings = ControllerSettings(
            stiffness_nm_per_rad=believed,
            sample_period_s=FRAME_PERIOD_S,
            window_s=FRAME_PERIOD_S,
            kp=kp,
            ki=KI_SHARE * kp * kp,
            wrist_bandwidth_per_s=BANDWIDTH_PER_S,
            ramp_nm_per_s=1e3,
            torque_limit_nm=1e3,
            speed_limit_rad_per_s=1e6,
            acceleration_limit_rad_per_s2=1e9,
            travel_limit_rad=1e6,
            age_limit_s=10.0,
            stale_periods=np.inf,
        )
        controller = TwistController(settings)
        # Known as if from very many measurements: the first ones are not averaged, the gain is kp throughout.
        controller.start(0, 0.0, 0.0, 1e9)
        controller.set_point(0.0)
        return controller


CASES = (
    Case("held speed,\nno compensator", compensated=False, held_speed=True),
    Case("late correction,\nno compensator", compensated=False),
    Case("twist controller", compensated=True),
    Case("twist controller,\ntool twice as stiff as believed", compensated=True, stiffness_ratio=2.0),
)


def simulated_boundary(case: Case, age_s: float, lost: int) -> float:
    """Return the gain at which a disturbance no longer dies out, bisected to half a per cent; inf above HIGHEST."""
    if not _grows(case, age_s, lost, HIGHEST):
        return np.inf
    low, high = LOWEST, HIGHEST
    while high > 1.005 * low:
        middle = float(np.sqrt(low * high))
        low, high = (low, middle) if _grows(case, age_s, lost, middle) else (middle, high)
    return float(np.sqrt(low * high))


def _grows(case: Case, age_s: float, lost: int, kp: float) -> bool:
    sensor = Sensor(period_s=FRAME_PERIOD_S, window_s=FRAME_PERIOD_S, transfer_s=age_s - 0.5 * FRAME_PERIOD_S)
    tool = Tool(stiffness_nm_per_rad=STIFFNESS, relaxing_share=0.0, actuation_s=ACTUATION_S)
    plant = Plant(tool, sensor, np.random.default_rng(0), COMMAND_S, disturbance_nm=START_NM)
    frames = FRAMES * CYCLE // (CYCLE - lost) + int(3 * age_s / FRAME_PERIOD_S)
    trace = run(plant, case.loop(kp), frames * FRAME_PERIOD_S, _keep(lost), bound_nm=100.0 * START_NM)
    if abs(trace.torque_nm[-1]) > 100.0 * START_NM:
        return True
    third = len(trace.torque_nm) // 3
    before, after = trace.torque_nm[third : 2 * third], trace.torque_nm[2 * third :]
    return bool(np.abs(after).max() > np.abs(before).max())


def _keep(lost: int) -> Callable[[Sample, int], bool]:
    return lambda _, number: number % CYCLE < CYCLE - lost


def computed_boundary(case: Case, age_s: float, lost: int) -> float:
    """Return the gain at which the loop becomes unstable according to its equations; inf above HIGHEST."""
    if not lost and not case.held_speed:
        return gain_limit(case.model(age_s), HIGHEST)
    if _radius(case, age_s, lost, HIGHEST) < 1.0:
        return np.inf
    low, high = LOWEST, HIGHEST
    while high > 1.0005 * low:
        middle = float(np.sqrt(low * high))
        low, high = (low, middle) if _radius(case, age_s, lost, middle) >= 1.0 else (middle, high)
    return float(np.sqrt(low * high))


def _radius(case: Case, age_s: float, lost: int, kp: float) -> float:
    """Return the spectral radius of the loop over one cycle of received and lost frames (Floquet)."""
    model = case.model(age_s, kp)
    seen = _response(case, model)[1:]
    received, cycle = _received(case, model, seen), np.eye(seen.size + 2)
    after_loss = _received(case, model, seen, missed=min(lost, 4))
    for number in range(CYCLE):
        frame = _lost(case, seen.size) if number >= CYCLE - lost else (received if number else after_loss)
        cycle = frame @ cycle
    return float(np.abs(np.linalg.eigvals(cycle)).max())


def _received(case: Case, model: LoopModel, seen: FloatArray, missed: int = 0) -> FloatArray:
    """Return what one received frame does to the state (d[k−1] … d[k−n], integral i, correction c held).

    Torques in the controller's scale: a frame shows −(seen · d), times the stiffness ratio.
    """
    size, ratio = seen.size, model.stiffness_ratio
    step = _lost(replace(case, held_speed=False), size)
    latest, integral = np.eye(size + 2)[0], np.eye(size + 2)[size]
    shown = -np.append(seen, (0.0, 0.0))
    base = latest + (missed * integral if case.compensated else 0.0)
    excess = (ratio - 1.0) * shown - base if case.compensated else ratio * shown
    step[size] = integral + model.ki * excess
    step[size + 1] = model.kp * excess + step[size]
    step[0] = base + step[size + 1]
    return step


def _lost(case: Case, size: int) -> FloatArray:
    """Return what one lost frame does to the state: nothing, but that a held speed goes on."""
    step = np.zeros((size + 2, size + 2))
    step[1:size, : size - 1] = np.eye(size - 1)
    step[0, 0] = step[size, size] = step[size + 1, size + 1] = 1.0
    if case.held_speed:
        step[0, size + 1] = 1.0
    return step


def _response(case: Case, model: LoopModel) -> FloatArray:
    if not case.held_speed:
        return pulse_response(model)
    # A held speed brings the wrist evenly to its correction, over one frame period.
    times = np.arange(0.0, FRAME_PERIOD_S + ACTUATION_S + 4 * COMMAND_S, COMMAND_S)
    ramp = np.clip((times - ACTUATION_S) / FRAME_PERIOD_S, 0.0, 1.0)
    return window_response(ramp, model)


def boundaries() -> dict[str, dict[str, list[list[float]]]]:
    """Return for each case, by axis, the rows [where, computed gain, simulated gain]."""
    return {
        case.name.replace("\n", " "): {
            "age_s": [[age, computed_boundary(case, age, 0), simulated_boundary(case, age, 0)] for age in AGES_S],
            "lost_of_8": [
                [lost, computed_boundary(case, EIT_AGE_S, lost), simulated_boundary(case, EIT_AGE_S, lost)]
                for lost in LOST
            ],
        }
        for case in CASES
    }


def worst_disagreement(rows: list[list[float]]) -> float:
    """Return the largest relative difference in gain of computed and simulated; inf where only one is finite."""
    differences = [abs(simulated / computed - 1.0) for _, computed, simulated in rows if np.isfinite(computed)]
    one_sided = any(np.isfinite(computed) != np.isfinite(simulated) for _, computed, simulated in rows)
    return np.inf if one_sided else max(differences, default=0.0)


def main() -> None:
    """Measure, write the numbers, draw the chart."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--out", type=Path, required=True, help="folder for stability_map.json and .png")
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    began = time.process_time()
    cases = boundaries()
    worst = {name: {axis: worst_disagreement(rows) for axis, rows in axes.items()} for name, axes in cases.items()}
    result = {
        "frame_period_s": FRAME_PERIOD_S,
        "eit_age_s": EIT_AGE_S,
        "boundaries": {name: {axis: _finite(rows) for axis, rows in axes.items()} for name, axes in cases.items()},
        "worst_disagreement": worst,
        "cpu_s": time.process_time() - began,
    }
    (args.out / "stability_map.json").write_text(json.dumps(result, indent=2) + "\n")
    print(json.dumps({"worst_disagreement": worst, "cpu_s": result["cpu_s"]}, indent=2))
    draw_stability(args.out / "stability_map.png", cases, EIT_AGE_S)


def _finite(rows: list[list[float]]) -> list[list[float | None]]:
    """Return the rows with None, which JSON knows, where a boundary lies above the map."""
    return [[value if np.isfinite(value) else None for value in row] for row in rows]


if __name__ == "__main__":
    main()
