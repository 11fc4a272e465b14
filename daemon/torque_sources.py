"""The torques of a configuration: which there are, how often each comes, and over what time it averages."""

from collections.abc import Mapping

from daemon.config import DaemonConfig
from daemon.eit.both import BOTH
from daemon.eit.opening import AnyEstimator
from daemon.eit.tracking import TrackedEstimator
from daemon.loop.senses import Source
from daemon.skin.setup import skin_source


def torque_sources(
    config: DaemonConfig, estimators: Mapping[str, AnyEstimator], both: TrackedEstimator | None
) -> dict[str, Source]:
    """Return how often each sensor's torque comes; the mean of several frames speaks of a longer time."""
    sources = {
        name: Source(
            name=name,
            period_s=own.frame_period_s,
            window_s=own.frame_period_s * own.average_frames,
            measures_torque=estimators[name].measures_torque,
        )
        for name, own in config.fingertips.items()
    }
    if both is not None:
        period_s = max(own.frame_period_s for own in config.fingertips.values())
        sources[BOTH] = Source(name=BOTH, period_s=period_s, window_s=period_s, measures_torque=both.measures_torque)
    skin = skin_source(config.skin) if config.skin is not None else None
    return sources if skin is None else {**sources, skin.name: skin}
