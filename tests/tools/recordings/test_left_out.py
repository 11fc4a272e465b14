"""What of a recording is not used is counted, and said by the commands that use it."""

import numpy as np
import pytest

from shearloop.bank.channels import PAPER_TABLE
from shearloop.daemon.messaging.messages import EitFrame, LoadTorque, Message, wire_map
from shearloop.daemon.recorder import schema
from shearloop.daemon.recorder.recorder import Identity, Recorder
from shearloop.drivers.load_cell import COUNTS_REASON
from shearloop.tools.frame_series import read_series
from shearloop.tools.recordings.replay import ReplayClock
from tests.sample_messages import sample

PERIOD_NS = 540_000_000
FRAMES, LOADS = 20, 100
MISSING, REPEATED = {("left", 7), ("left", 11)}, ("left", 15)


@pytest.fixture
def recording(tmp_path):
    """A recording of two sides: the left board repeats a frame and lacks two; every tenth torque is not valid."""
    clock = ReplayClock()
    recorder = Recorder(tmp_path / "recordings", Identity(schema.basic_identity("a test")), clock)
    random, numbers = np.random.default_rng(2), dict[str, int]()

    def publish(message: Message) -> None:
        number = numbers[message.topic] = numbers.get(message.topic, -1) + 1
        clock.set(message.t_mono_ns)
        recorder.record_message(message.topic, wire_map(message, 0.0, number))

    channels = {}
    for number in range(FRAMES):
        for side in ("right", "left"):
            if (side, number) in MISSING:
                continue
            if (side, number) != REPEATED:
                channels[side] = np.round(random.uniform(0.01, 0.5, len(PAPER_TABLE.line_slots)), 4)
            frame = {"channels": channels[side], "line": PAPER_TABLE.line_of_channels(channels[side])}
            stamped = {"t_mono_ns": number * PERIOD_NS, "age_s": 0.27, "repeated": False}
            publish(sample(EitFrame, source=side, **frame, **stamped))
    for number in range(LOADS):
        reason = {"valid": False, "reason": COUNTS_REASON.clause} if number % 10 == 9 else {"valid": True, "reason": ""}
        publish(sample(LoadTorque, source="load_cell", t_mono_ns=number * 90_000_000, torque_nm=0.01, **reason))
    recorder.close()
    assert recorder.failure == ""
    return recorder.closed_files[0]


def test_readings_and_frames_that_are_not_used_are_counted(recording):
    (both,) = read_series(recording)
    assert len(both.t_s) == FRAMES - 3
    assert len(both.torque_nm) == LOADS - 10
    loads, repeated, unpaired = both.left_out
    assert loads == f"10 of 100 readings of the load cell, not valid, e.g. {COUNTS_REASON.clause}"
    assert repeated == "1 frame of the left side, repeated by the board"
    assert unpaired == "3 frames of the right side, without one of the others at that time"
    (right,) = read_series(recording, ("right",))
    assert right.left_out == both.left_out[:2]


def test_a_recording_that_is_used_whole_says_nothing(imported):
    for one in read_series(imported, ("right",)):
        assert one.left_out == ()
