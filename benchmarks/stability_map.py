"""Finds where the twist loop becomes unstable: gain over delay, computed and simulated, and over lost frames.

    python -m benchmarks.stability_map --out run/stability_map.json

Three loops at the EIT's rate, without noise: one without a delay compensator, the twist controller with the right
stiffness, and the twist controller with a tool twice as stiff as it assumes. The simulated boundary comes from a
bisection with the real controller on the simulated plant. The computed boundary comes from the equations of the
margins, without lost frames.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from benchmarks.common import parser_of, table_head, table_row, write_figures
from shearloop.daemon.control.margins import LoopModel, gain_limit, integral_gain
from shearloop.daemon.control.torque_controller import ControllerSettings, TorqueController, WristLimit
from shearloop.drivers.defaults import FRAME_PERIOD_S
from shearloop.studies.charts import simulated_loop

COMMAND_S = 0.016
ACTUATION_S = 0.02
BANDWIDTH_PER_S = 4.0
STIFFNESS = 0.25
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

    def model(self, age_s: float) -> LoopModel:
        """Return the model for the computed boundary."""
        return LoopModel(
            sample_period_s=FRAME_PERIOD_S, window_s=FRAME_PERIOD_S, age_s=age_s, actuation_s=ACTUATION_S,
            wrist_bandwidth_per_s=BANDWIDTH_PER_S, kp=0.1, ki=integral_gain(0.1), command_period_s=COMMAND_S,
            stiffness_ratio=self.stiffness_ratio, compensated=self.compensated,
        )  # fmt: skip

    def controller(self, kp: float) -> simulated_loop.LoopController:
        """Return the real controller, without limits."""
        believed, ki = STIFFNESS / self.stiffness_ratio, integral_gain(kp)
        settings = ControllerSettings(
            stiffness_nm_per_rad=believed, sample_period_s=FRAME_PERIOD_S, window_s=FRAME_PERIOD_S, kp=kp, ki=ki,
            wrist_bandwidth_per_s=BANDWIDTH_PER_S, ramp_nm_per_s=1e3, deadband_nm=0.0,
            wrist_limit=WristLimit(1e6, 1e9), travel_limit_rad=1e6, age_limit_s=10.0,
            fresh_s=np.inf,
        )  # fmt: skip
        if not self.compensated:
            return simulated_loop.UncompensatedController(settings)
        # Enough known measurements for a gain of kp from the start.
        return TorqueController(settings, 0, 0.0, 0.0, 1e9)


CASES = (
    LoopCase("no compensator", compensated=False),
    LoopCase("twist controller", compensated=True),
    LoopCase("twist controller, tool twice as stiff as believed", compensated=True, stiffness_ratio=2.0),
)


def boundary(case: LoopCase, age_s: float, lost: int) -> dict[str, float | None]:
    """Return the simulated gain at the boundary, and without losses the computed one; None above HIGHEST."""
    gains = {"computed": np.inf if lost else gain_limit(case.model(age_s), HIGHEST)}
    gains["simulated"] = simulated_boundary(case, age_s, lost)
    return {"age_s": age_s, "lost": lost} | {name: gain if gain < np.inf else None for name, gain in gains.items()}


def simulated_boundary(case: LoopCase, age_s: float, lost: int) -> float:
    """Return the gain where a disturbance stops dying out, to half a per cent; inf above HIGHEST."""
    if not _grows(case, age_s, lost, HIGHEST):
        return np.inf
    low, high = LOWEST, HIGHEST
    while high > 1.005 * low:
        middle = float(np.sqrt(low * high))
        low, high = (low, middle) if _grows(case, age_s, lost, middle) else (middle, high)
    return float(np.sqrt(low * high))


def _grows(case: LoopCase, age_s: float, lost: int, kp: float) -> bool:
    sensor = simulated_loop.SimulatedSensor(period_s=FRAME_PERIOD_S, transfer_s=age_s - 0.5 * FRAME_PERIOD_S)
    tool = simulated_loop.SimulatedTool(stiffness_nm_per_rad=STIFFNESS, relaxing_share=0.0, actuation_s=ACTUATION_S)
    plant = simulated_loop.Plant(tool, sensor, np.random.default_rng(0), COMMAND_S, disturbance_nm=START_NM)
    frames = FRAMES * CYCLE // (CYCLE - lost) + int(3 * age_s / FRAME_PERIOD_S)
    trace = simulated_loop.run(
        plant, case.controller(kp), frames * FRAME_PERIOD_S, lambda number: number % CYCLE < CYCLE - lost,
        bound_nm=100.0 * START_NM,
    )  # fmt: skip
    if abs(trace.torque_nm[-1]) > 100.0 * START_NM:
        return True
    third = len(trace.torque_nm) // 3
    before, after = trace.torque_nm[third : 2 * third], trace.torque_nm[2 * third :]
    return bool(np.abs(after).max() > np.abs(before).max())


def worst_disagreement(rows: Iterable[Mapping[str, float | None]]) -> float:
    """Return the largest relative difference of computed and simulated gain without losses."""
    pairs = [(row["computed"] or np.inf, row["simulated"] or np.inf) for row in rows if not row["lost"]]
    return max((abs(simulated / computed - 1.0) for computed, simulated in pairs if computed != simulated), default=0.0)


def main() -> None:
    """Measure, write the numbers, draw the chart."""
    args = parser_of(__doc__).parse_args()
    points = [(age, 0) for age in AGES_S] + [(EIT_AGE_S, lost) for lost in LOST[1:]]
    found = {case.name: [boundary(case, *point) for point in points] for case in CASES}
    print(table_head("loop", "age, s", "lost of 8", "computed gain", "simulated gain"))
    for name, rows in found.items():
        print(*(table_row(name, *row.values()) for row in rows), sep="\n")
    write_figures(args.out, found)
    print(f"largest disagreement {worst_disagreement([row for rows in found.values() for row in rows]):.1%}")


if __name__ == "__main__":
    main()
