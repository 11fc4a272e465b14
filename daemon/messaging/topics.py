"""The table of topics: what is published, and how often it should come."""

from shearloop.daemon.messaging.messages import (
    EitEstimate,
    EitFrame,
    EitHeatmap,
    GripperStateMessage,
    Health,
    LoadTorque,
    LoopState,
    Message,
    RobotStateMessage,
    SkinShear,
)

TOPICS: dict[str, type[Message]] = {
    kind.topic: kind
    for kind in (
        EitFrame,
        EitEstimate,
        EitHeatmap,
        LoadTorque,
        SkinShear,
        RobotStateMessage,
        GripperStateMessage,
        LoopState,
        Health,
    )
}

# A message older than this many of its topic's periods is stale.
STALE_AFTER_PERIODS = 2.5


def stale_after_s(topic: str) -> float:
    """Return the age, in seconds, beyond which a topic's latest message says nothing of the present.

    Raises KeyError for a topic that is unknown or only sent on change.
    """
    rate_hz = TOPICS[topic].rate_hz
    if rate_hz is None:
        raise KeyError(f"{topic} has no expected rate")
    return STALE_AFTER_PERIODS / rate_hz
