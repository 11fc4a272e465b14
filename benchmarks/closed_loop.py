"""A controller on a plant: what both benches do, a command period at a time, with simulated time."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from benchmarks.plant import Plant, Sample
from shearloop.daemon.control.controller import WristCommand
from shearloop.daemon.control.identification import ExciteSettings, StiffnessExcitation


class Loop(Protocol):
    """What the twist controller and its alternatives have in common."""

    def measure(self, torque_nm: float | None, t_mid_ns: int, t_ns: int) -> object:
        """Take in a torque."""

    def command(self, t_ns: int, wrist_angle_rad: float) -> WristCommand:
        """Return the wrist speed for now."""


@dataclass(frozen=True, slots=True)
class Trace:
    """What happened, a row for each command period: time, true torque, wrist angle (n,), and whether it was held."""

    t_s: NDArray[np.float64]
    torque_nm: NDArray[np.float64]
    angle_rad: NDArray[np.float64]
    held: NDArray[np.bool_]


def nanoseconds(time_s: float) -> int:
    """Return a time of the simulation as the controller wants it."""
    return round(time_s * 1e9)


def every(_: Sample, __: int) -> bool:
    """Keep every measurement."""
    return True


def run(
    plant: Plant,
    loop: Loop,
    duration_s: float,
    keep: Callable[[Sample, int], bool] = every,
    bound_nm: float = np.inf,
) -> Trace:
    """Close the loop for a time, or until the torque leaves the bound; `keep` drops measurements by their number."""
    rows = []
    end_s, count = plant.t_s + duration_s, 0
    while plant.t_s < end_s and abs(plant.torque_nm) <= bound_nm:
        now_ns = nanoseconds(plant.t_s)
        for sample in plant.collect():
            if keep(sample, count):
                loop.measure(sample.torque_nm, nanoseconds(sample.t_mid_s), now_ns)
            count += 1
        command = loop.command(now_ns, plant.angle_rad)
        plant.step(command.speed_rad_per_s)
        rows.append((plant.t_s, plant.torque_nm, plant.angle_rad, command.holds))
    table = np.array(rows, dtype=float)
    return Trace(table[:, 0], table[:, 1], table[:, 2], table[:, 3].astype(bool))


def identify_on(plant: Plant, settings: ExciteSettings) -> StiffnessExcitation:
    """Run the identification step on a plant to its end."""
    step = StiffnessExcitation(settings)
    while not step.done:
        now_ns = nanoseconds(plant.t_s)
        for sample in plant.collect():
            step.measure(sample.torque_nm, nanoseconds(sample.t_mid_s), now_ns)
        plant.step(step.command(now_ns, plant.angle_rad))
    return step
