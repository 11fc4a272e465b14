"""Which tool a daemon's recording is of: by its experiment, by the gripper, by who calibrates; and if they disagree."""

from collections.abc import Collection
from pathlib import Path

import numpy as np
import pytest

from shearloop.daemon.clock import Clock
from shearloop.daemon.messaging.messages import EitFrame, wire_map
from shearloop.daemon.recorder.recorder import Identity, Recorder
from shearloop.daemon.recorder.schema import basic_identity
from shearloop.daemon.sensing.session_inputs import session_inputs
from shearloop.drivers.serial_sensor import InputKind, RawEvent
from shearloop.errors import UserError
from shearloop.estimation import BeforeFrame, HeldTool, Measured
from shearloop.tools.frame_series import not_of_tool, read_series, series_of
from shearloop.tools.recordings.frames import read_recording
from shearloop.tools.recordings.summary import summarise
from tests.sample_messages import sample

PERIOD_NS = 540_000_000
TEN, TWENTY = Measured(10.2, 1.2), Measured(20.1, 1.2)


class Held(Clock):
    """A clock that shows what it is told."""

    t_ns = 0

    def now_ns(self) -> int:
        return self.t_ns


def recorded(
    folder: Path, *held: tuple[int, Measured | None], named_mm: float | None = None, moved: Collection[int] = ()
) -> Path:
    """Record 40 frames as a daemon does; from the frame with each number on the gripper holds another tool, or none.

    The fingers moved during the frames `moved`.
    """
    clock, values = Held(), dict(held)
    recorder = Recorder(folder, Identity(basic_identity("a test")), clock)
    recorder.record_experiment("twist", tool_mm=named_mm)
    for number in range(40):
        clock.t_ns += PERIOD_NS
        recorder.input_recorder("right").record(RawEvent(InputKind.DATA, clock.t_ns, b'"kind":"tool", said the board'))
        if number in values:
            (event,) = session_inputs(number, BeforeFrame(tool=HeldTool(values[number])), clock.t_ns - PERIOD_NS // 2)
            recorder.input_recorder("right").record(event)
        if number in moved:
            (event,) = session_inputs(number, BeforeFrame(fingers_moved=True), clock.t_ns)
            recorder.input_recorder("right").record(event)
        line = np.random.default_rng(number).uniform(0.01, 0.5, 1024)
        t_ns = clock.t_ns - PERIOD_NS // 2
        message = sample(EitFrame, source="right", t_mono_ns=t_ns, line=line, frame=number, age_s=0.3)
        recorder.record_message("eit.frame", wire_map(message, 0.0, number))
    recorder.close()
    return recorder.closed_files[0]


def test_the_experiment_names_its_tool(tmp_path, ran):
    path = recorded(tmp_path, (5, Measured(20.4, 1.2)), (35, None), named_mm=20.0)
    (series,) = read_series(path)
    assert series.tool_mm == Measured(20.0, 0.0), "and the gripper, which is not as exact, agrees"
    assert series.gripper_mm is None
    assert read_series(path, tool_mm=30.0)[0].tool_mm == Measured(20.0, 0.0), "a recording that names it knows better"
    assert summarise(path).tool_mm == "20"
    assert "  tool     20 mm\n" in ran("recording", "info", path).out


def test_a_stated_tool_that_counts_nowhere_is_refused(tmp_path):
    paths = recorded(tmp_path / "named", named_mm=20.0), recorded(tmp_path / "unnamed")
    named, unnamed = ((path.parent.name, *read_series(path, tool_mm=30.0)) for path in paths)
    with pytest.raises(UserError, match="named names its tool, of 20 mm, and --tool-mm 30 counts only where nothing"):
        not_of_tool([named], 30.0)
    assert not_of_tool([named, unnamed], 30.0) == [
        "named: --tool-mm 30, because the recording names its tool, of 20 mm"
    ]
    assert not_of_tool([named], 20.0) == not_of_tool([named, unnamed], None) == []


def test_a_recording_knows_which_frames_saw_the_fingers_move(tmp_path):
    (series,) = read_series(recorded(tmp_path, moved=(3, 4, 39)))
    assert [number for number, one in enumerate(series.frames()) if one.fingers_moved] == [3, 4, 39]
    (series,) = read_series(recorded(tmp_path / "resting"))
    assert not any(one.fingers_moved for one in series.frames())


def test_the_gripper_says_which_tool_it_held(tmp_path):
    # Something in its way for a moment is no other tool; nor is one that comes by a count nearer.
    path = recorded(tmp_path, (5, TWENTY), (20, TEN), (21, Measured(19.6, 1.2)), (35, None))
    (series,) = read_series(path)
    assert series.tool_mm == TWENTY
    assert np.isnan(series.diameter_mm).all(), "which is no truth to fit a diameter to"
    assert series.between(10, 20).select_sides(("right",)).tool_mm == TWENTY
    assert read_series(path, tool_mm=20.0)[0].tool_mm == Measured(20.0, 0.0)


def test_a_gripper_that_reports_no_width_leaves_the_tool_unknown(tmp_path):
    for number, held in enumerate(((), ((5, None),), ((39, TEN), (40, TWENTY)))):
        (series,) = read_series(recorded(tmp_path / str(number), *held))
        assert series.tool_mm == (TEN if number == 2 else None)


@pytest.mark.parametrize(
    ("named_mm", "held", "why"),
    [
        (20.0, ((5, TEN),), "it names a tool of 20 mm, and the gripper held one of 10.2 mm"),
        (None, ((5, TEN), (20, TWENTY)), "the gripper held tools of 20.1 and 10.2 mm"),
    ],
)
def test_contradictory_tools_are_refused_unless_the_caller_names_the_tool(tmp_path, named_mm, held, why):
    recording = read_recording(recorded(tmp_path, *held, named_mm=named_mm))
    with pytest.raises(UserError, match=why):
        series_of(recording)
    assert series_of(recording, tool_mm=20.5).tool_mm == Measured(20.5, 0.0)
