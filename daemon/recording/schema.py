"""What stands in a recording: topics, their JSON schemas, and the metadata that says what it was made with.

A recording is an MCAP file (mcap.dev). Log times are Unix nanoseconds: of a frame the middle of its acquisition, of a
torque when it was measured. Any MCAP tool can show and plot one; the schemas describe every key.
"""

from typing import Any

FRAME_TOPIC = "eit.frame"
LOAD_TOPIC = "load.torque"
# MCAP metadata record with the identities; a reader refuses a file without it.
METADATA = "shearloop"
FORMAT_VERSION = "1"
PROFILE = "shearloop"
SIDES = ("right", "left")

_NUMBER = {"type": "number"}

SCHEMAS: dict[str, dict[str, Any]] = {
    FRAME_TOPIC: {
        "title": FRAME_TOPIC,
        "type": "object",
        "properties": {
            "arrival_unix_ns": {"type": "integer", "description": "when the last byte of the line was read"},
            "line": {
                "type": "array",
                "items": _NUMBER,
                "minItems": 1024,
                "maxItems": 1024,
                "description": "the 1024 values of the raw line in V, in the board's order",
            },
        },
        "required": ["arrival_unix_ns", "line"],
    },
    LOAD_TOPIC: {
        "title": LOAD_TOPIC,
        "type": "object",
        "properties": {"torque_nm": {**_NUMBER, "description": "torque on the lever in N·m"}},
        "required": ["torque_nm"],
    },
}


def frame_topic(side: str) -> str:
    """Return the topic of a side's frames."""
    return f"{FRAME_TOPIC}.{side}"


def schema_of(topic: str) -> str:
    """Return the name of a topic's schema."""
    return FRAME_TOPIC if topic.startswith(f"{FRAME_TOPIC}.") else topic
