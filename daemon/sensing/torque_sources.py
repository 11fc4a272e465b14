"""The torques of a configuration: which there are, how often each comes, and over what time it averages."""

from collections.abc import Mapping

from shearloop.daemon.config import DaemonConfig
from shearloop.daemon.control.loop_inputs import TorqueSource
from shearloop.daemon.sensing.both import COMBINED
from shearloop.daemon.sensing.opening import AnyEstimator
from shearloop.daemon.sensing.skin_task import skin_source
from shearloop.daemon.sensing.tracking import TrackedEstimator


def torque_sources(
    config: DaemonConfig, estimators: Mapping[str, AnyEstimator], both: TrackedEstimator | None
) -> dict[str, TorqueSource]:
    """Return how often each sensor's torque comes; the mean of several frames speaks of a longer time."""
    sources = {
        name: TorqueSource(
            name=name,
            period_s=own.frame_period_s,
            window_s=own.frame_period_s * own.average_frames,
            measures_torque=estimators[name].measures_torque,
        )
        for name, own in config.fingertips.items()
    }
    if both is not None:
        period_s = max(own.frame_period_s for own in config.fingertips.values())
        sources[COMBINED] = TorqueSource(
            name=COMBINED, period_s=period_s, window_s=period_s, measures_torque=both.measures_torque
        )
    skin = skin_source(config.skin) if config.skin is not None else None
    return sources if skin is None else {**sources, skin.name: skin}
