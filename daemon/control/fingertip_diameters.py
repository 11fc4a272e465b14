"""Diameter of the tool from the fingertips. No I/O; times are passed in."""

from collections.abc import Mapping

from shearloop.daemon.torques import TorqueSource
from shearloop.estimation import Estimate, Measured, combine


class FingertipDiameters:
    """The latest diameter of each fingertip, and of all together."""

    def __init__(self, combined: str, sources: Mapping[str, TorqueSource]) -> None:
        """`combined` is the source that already combines the fingertips; a diameter is fresh as long as a torque."""
        self._combined = combined
        self._sources = sources
        self._latest: dict[str, tuple[int, Measured]] = {}

    def update(self, source: str, estimate: Estimate, t_ns: int) -> None:
        """Take a source's estimate at t_ns."""
        low_mm, high_mm = estimate.diameter_low_mm, estimate.diameter_high_mm
        if estimate.diameter_mm is None or low_mm is None or high_mm is None:
            self._latest.pop(source, None)
        else:
            self._latest[source] = (t_ns, Measured(estimate.diameter_mm, 0.5 * (high_mm - low_mm)))

    def latest(self, t_ns: int) -> Measured | None:
        """Return the fingertips' diameter at t_ns, None where none of them has a recent one."""
        fresh = {
            name: diameter
            for name, (then_ns, diameter) in self._latest.items()
            if t_ns - then_ns <= self._sources[name].fresh_s * 1e9
        }
        return fresh.get(self._combined) or combine(*fresh.values())
