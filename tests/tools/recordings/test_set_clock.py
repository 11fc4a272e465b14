"""A wall clock that is set during a recording, or a suspended computer, changes nothing that is read from it."""

import asyncio
import csv
import io
import json
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
import zmq
from mcap.reader import make_reader
from scipy.io import loadmat
from structlog.testing import capture_logs

from shearloop.bank.channels import PAPER_TABLE
from shearloop.daemon import supervisor
from shearloop.daemon.clock import Clock, ClockReading
from shearloop.daemon.messaging.messages import (
    EitEstimate,
    EitFrame,
    GripperStateMessage,
    LoadTorque,
    Message,
    wire_map,
)
from shearloop.daemon.messaging.publisher import Publisher
from shearloop.daemon.recorder import schema
from shearloop.daemon.recorder.recorder import AttachedFile, Identity, Recorder
from shearloop.daemon.recorder.writer import McapFile
from shearloop.drivers.serial_sensor import InputKind, RawEvent
from shearloop.tools.frame_series import read_series
from shearloop.tools.recordings.frames import read_recording
from shearloop.tools.recordings.listing import list_recordings
from shearloop.tools.recordings.reader import read_messages
from shearloop.tools.recordings.repair import repair
from shearloop.tools.recordings.summary import summarise
from shearloop.tools.recordings.tables import read
from tests.running import running
from tests.sample_messages import sample

MS = 1_000_000
LENGTH_MS, STEP_AT_MS = 40_000, 20_250
UNIX_NS = 1_795_000_000 * 10**9
DAYS_S = 2 * 86400.0
LATE_TOPIC = "gripper.state"
STEPS = {"back by 5 s": -5.0, "back by 30 s": -30.0, "forward by two days": DAYS_S}
IDENTITY = Identity(schema.basic_identity("a test"), (AttachedFile(schema.CONFIGURATION, "application/json", b"{}"),))


class SetClock(Clock):
    """A clock in simulated time, whose wall clock is set, or which is suspended, at STEP_AT_MS of CLOCK_MONOTONIC."""

    def __init__(self, set_s: float = 0.0, suspended_s: float = 0.0) -> None:
        self.t_ns = 0
        self._set_s, self._suspended_s = set_s, suspended_s
        super().__init__()

    def now_ns(self) -> int:
        return self.t_ns

    def _measured(self) -> ClockReading:
        happened = self.t_ns >= STEP_AT_MS * MS
        suspended_ns = round(self._suspended_s * 1e9) * happened
        # Two readings of clocks are never taken at once.
        jitter_ns = self.t_ns // (1000 * MS) * 37 % 500
        return ClockReading(UNIX_NS + jitter_ns + round(self._set_s * 1e9) * happened + suspended_ns, suspended_ns)


def recorded(folder: Path, clock: SetClock) -> Path:
    """Record a fingertip and a load cell as a daemon does: frames arrive after loads that are younger."""
    recorder, random, numbers = Recorder(folder, IDENTITY, clock), np.random.default_rng(1), dict[str, int]()

    def publish(message: Message) -> None:
        number = numbers[message.topic] = numbers.get(message.topic, -1) + 1
        recorder.record_message(message.topic, wire_map(message, clock.unix_s(message.t_mono_ns), number))

    recorder.record_experiment("twist", tool_mm=20.0)
    for t_ms in range(0, LENGTH_MS, 10):
        clock.t_ns = t_ms * MS
        if t_ms % 1000 == 0:
            clock.synchronise()
        if t_ms % 90 == 0:
            publish(sample(LoadTorque, source="load_cell", t_mono_ns=clock.t_ns, torque_nm=np.sin(t_ms / 3000)))
        if t_ms > 30_000 and t_ms % 1000 == 0:
            publish(sample(GripperStateMessage, source="gripper", t_mono_ns=clock.t_ns))
        if t_ms % 540 == 530:
            recorder.input_recorder("right").record(RawEvent(InputKind.DATA, clock.t_ns, b"0.1"))
            middle_ns = clock.t_ns - 270 * MS
            channels = np.round(random.uniform(0.01, 0.5, len(PAPER_TABLE.line_slots)), 4)
            arrays = {"channels": channels, "line": PAPER_TABLE.line_of_channels(channels)}
            publish(sample(EitFrame, source="right", t_mono_ns=middle_ns, age_s=0.27, repeated=False, **arrays))
            publish(sample(EitEstimate, source="right", t_mono_ns=middle_ns, torque_nm=np.sin(t_ms / 3000)))
            recorder.write()
    recorder.close()
    assert recorder.failure == ""
    (path,) = recorder.closed_files
    return path


def by_the_wall_clock(path: Path) -> Path:
    """Return a copy without the one offset: each Unix time is of the wall clock as it was then."""
    old = path.with_name(f"old-{path.name}")
    file = McapFile(io.FileIO(f"{old}.partial", "wb"))
    with path.open("rb") as source:
        reader = make_reader(source)
        identity = dict(next(one.metadata for one in reader.iter_metadata() if one.name == schema.METADATA))
        one_offset_ns = int(identity.pop(schema.CLOCK_OFFSET))
        file.identify(identity)
        for one in reader.iter_metadata():
            if one.name != schema.METADATA:
                file.add_metadata(one.name, one.metadata)
        for one in reader.iter_attachments():
            file.attach(one.name, one.media_type, one.data, one.log_time)
        shift_ns = 0
        for _, channel, message in reader.iter_messages(log_time_order=False):
            content = json.loads(message.data)
            if channel.topic == schema.CLOCK_TOPIC:
                shift_ns = content["offset_ns"] - one_offset_ns
                del content[schema.SUSPENDED]
            if "timestamp" in content:
                content["timestamp"] = (message.log_time + shift_ns) / 1e9
            if schema.ARRIVAL in content:
                content[schema.ARRIVAL] += shift_ns
            times = message.log_time + shift_ns, message.publish_time + shift_ns
            file.add(channel.topic, *times, json.dumps(content, separators=(",", ":")).encode())
    file.close(old)
    return old


@pytest.fixture(scope="module")
def plain(tmp_path_factory) -> Path:
    """The recording of a clock that is not set."""
    return recorded(tmp_path_factory.mktemp("plain"), SetClock())


@pytest.fixture(params=[f"{age} {step}" for step in STEPS for age in ("new", "old")])
def stepped(request, tmp_path) -> Iterator[Path]:
    """The same with a step, and the same in the form that has log times of the wall clock."""
    age, _, step = request.param.partition(" ")
    path = recorded(tmp_path / "stepped", SetClock(STEPS[step]))
    return by_the_wall_clock(path) if age == "old" else path


def test_frames_and_loads_keep_their_times(plain, stepped):
    truth, found = read_recording(plain), read_recording(stepped)
    assert (np.diff(truth.torque_t_ns) == 90 * MS).all()
    np.testing.assert_array_equal(found.torque_t_ns, truth.torque_t_ns)
    np.testing.assert_array_equal(found.torque_nm, truth.torque_nm)
    np.testing.assert_array_equal(found.sides["right"].t_mid_ns, truth.sides["right"].t_mid_ns)
    np.testing.assert_array_equal(found.sides["right"].lines, truth.sides["right"].lines)
    assert found.notes == truth.notes


def test_calibrate_and_evaluate_get_the_same_series(plain, stepped):
    """Both read recordings as series only."""
    (truth,), (found,) = read_series(plain), read_series(stepped)
    for name in ("t_s", "channels", "torque_t_s", "torque_nm", "diameter_mm"):
        np.testing.assert_array_equal(getattr(found, name), getattr(truth, name))


@pytest.mark.long
def test_every_export_is_the_same(plain, stepped, tmp_path, ran):
    pytest.importorskip("pyarrow", reason="needs the extra `export`")
    topics = ("eit.frame.right", "eit.estimate.right", "load.torque", "input.right")
    chosen = [part for topic in topics for part in ("--topic", topic)]
    for form in ("csv", "lerobot"):
        for path, name in ((plain, "truth"), (stepped, "found")):
            ran("recording", "export", path, "--format", form, "--out", tmp_path / form / name, *chosen)
    for topic in topics:
        truth, found = ((tmp_path / "csv" / name / f"{topic}.csv").read_bytes() for name in ("truth", "found"))
        assert found == truth, topic
    rows = "data/chunk-000/file-000.parquet"
    truth, found = ((tmp_path / "lerobot" / name / rows).read_bytes() for name in ("truth", "found"))
    assert found == truth


def test_info_has_the_same_rates_and_reports_the_step(plain, stepped, ran):
    truth, found = summarise(plain), summarise(stepped)
    assert found.topics["load.torque"].rate_hz == pytest.approx(1 / 0.09)
    assert found.topics == truth.topics
    assert (found.first_unix_ns, found.duration_s) == (truth.first_unix_ns, truth.duration_s)
    assert truth.clock_steps == []
    (step,) = found.clock_steps
    # The daemon looks once a second.
    assert step.after_s == pytest.approx(21.0, abs=0.2)
    assert any(step.set_s == pytest.approx(set_s, abs=1e-5) for set_s in STEPS.values())
    assert step.suspended_s == 0
    printed, _ = ran("recording", "info", stepped)
    way = "back" if step.set_s < 0 else "forward"
    words = f"{step.after_s:.1f} s after the first message: the wall clock was set {way} by {abs(step.set_s):.1f} s;"
    assert words in printed
    assert "damaged" not in printed


def test_a_list_has_the_times_of_info(plain, stepped):
    (listed,) = (one for one in list_recordings(stepped.parent) if one.path == str(stepped))
    truth = summarise(plain)
    assert (listed.first_unix_ns, listed.duration_s) == (truth.first_unix_ns, truth.duration_s)
    assert listed.experiments == ("twist",)


def test_a_topic_that_begins_after_the_step_has_the_same_offset(plain, stepped):
    """What is read does not depend on which topics are read with it."""
    truth, found = ([one for _, one, _ in read_messages(path, [LATE_TOPIC])] for path in (plain, stepped))
    assert found[0]["timestamp"] > (UNIX_NS + STEP_AT_MS * MS) / 1e9
    assert found == truth


def test_a_repaired_copy_has_the_same_times(plain, stepped, tmp_path):
    copy = repair(stepped, tmp_path / "copy.mcap").path
    np.testing.assert_array_equal(read_recording(copy).torque_t_ns, read_recording(plain).torque_t_ns)
    assert len(summarise(copy).clock_steps) == 1


@pytest.mark.long
@pytest.mark.parametrize("age", ["new", "old"])
@pytest.mark.parametrize("set_s", [-5.0, -2e-9], ids=["a step back", "a reading of the clocks"])
def test_bunched_readings_keep_their_places_in_every_table(set_s, age, tmp_path, ran):
    """Readings of one read of the port are a nanosecond apart, and the Unix stamps of some are reversed."""
    parquet = pytest.importorskip("pyarrow.parquet", reason="needs the extra `export`")
    clock = SetClock(set_s)
    recorder = Recorder(tmp_path / "new", IDENTITY, clock)
    recorder.record_experiment("twist")
    recorder.input_recorder("load_cell").record(RawEvent(InputKind.DATA, 0, b"1"))
    # The clock is set between two of them.
    times = [STEP_AT_MS * MS + number for number in range(-4, 5)]
    wall_ns = []
    for number, clock.t_ns in enumerate(times):
        clock.synchronise()
        wall_ns.append(clock.t_ns + clock.offset_ns)
        message = sample(LoadTorque, source="load_cell", t_mono_ns=clock.t_ns, torque_nm=number / 1000)
        recorder.record_message(message.topic, wire_map(message, clock.unix_s(clock.t_ns), number))
    recorder.close()
    assert wall_ns != sorted(wall_ns)
    (path,) = recorder.closed_files
    path = by_the_wall_clock(path) if age == "old" else path
    for form in ("csv", "parquet", "mat"):
        ran("recording", "export", path, "--format", form, "--topic", "load.torque", "--out", tmp_path / form)
    with (tmp_path / "csv" / "load.torque.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    struct = loadmat(tmp_path / "mat.mat", squeeze_me=True)["load_torque"]
    tables = {
        "csv": {key: [row[key] for row in rows] for key in rows[0]},
        "parquet": parquet.read_table(tmp_path / "parquet" / "load.torque.parquet").to_pydict(),
        "mat": {key: struct[key].item() for key in struct.dtype.names},
        "read": read(path)["load.torque"],
    }
    for name, table in tables.items():
        assert [int(one) for one in table["t_mono_ns"]] == times, name
        assert [float(one) for one in table["torque_nm"]] == [number / 1000 for number in range(9)], name
        assert np.diff([int(one) for one in table["log_time_ns"]]).tolist() == [1] * 8, name


def test_a_suspend_is_reported_and_changes_nothing_else(plain, tmp_path):
    path = recorded(tmp_path / "suspended", SetClock(suspended_s=3600.0))
    np.testing.assert_array_equal(read_recording(path).torque_t_ns, read_recording(plain).torque_t_ns)
    (step,) = summarise(path).clock_steps
    assert (step.set_s, step.suspended_s) == (0, 3600.0)
    assert str(step) == "the computer was suspended for 3600.0 s"


def test_all_unix_times_of_a_file_have_its_offset(tmp_path):
    """Programs that read the file without shearloop see one clock as well."""
    path = recorded(tmp_path, SetClock(-30.0))
    with path.open("rb") as file:
        reader = make_reader(file)
        offset_ns = int(reader.get_summary().channels[1].metadata[schema.CLOCK_OFFSET])
        for _, _, message in reader.iter_messages(log_time_order=False):
            content = json.loads(message.data)
            assert message.log_time == content["t_mono_ns"] + offset_ns
            assert content.get("timestamp", message.log_time / 1e9) == message.log_time / 1e9
            assert content.get(schema.ARRIVAL, message.publish_time) == message.publish_time


def test_a_file_that_begins_after_the_step_has_the_new_time(tmp_path):
    clock = SetClock(DAYS_S)
    recorder = Recorder(tmp_path, IDENTITY, clock)
    for t_ms, name in ((0, "one"), (30_000, "two")):
        clock.t_ns = t_ms * MS
        clock.synchronise()
        recorder.record_experiment(name)
        message = sample(LoadTorque, source="load_cell", t_mono_ns=clock.t_ns)
        recorder.record_message(message.topic, wire_map(message, clock.unix_s(clock.t_ns), 0))
    recorder.close()
    first, second = recorder.closed_files
    began_ns = [next(read_messages(path, ["load.torque"]))[2].log_time for path in (first, second)]
    assert began_ns[1] - began_ns[0] == pytest.approx((DAYS_S + 30.0) * 1e9, abs=1e4)
    assert [summarise(path).clock_steps for path in (first, second)] == [[], []]


@pytest.mark.parametrize(
    ("set_s", "suspended_s", "words"),
    [
        (0.09, 0.0, None),
        (-0.09, 0.09, None),
        (0.2, 0.0, "the wall clock was set forward by 0.2 s"),
        (-5.0, 0.0, "the wall clock was set back by 5.0 s"),
        (0.0, 60.0, "the computer was suspended for 60.0 s"),
        (-2.0, 60.0, "the computer was suspended for 60.0 s and the wall clock was set back by 2.0 s"),
    ],
)
def test_a_step_is_what_ntp_does_not_slew(set_s, suspended_s, words):
    clock = SetClock(set_s, suspended_s)
    clock.t_ns = STEP_AT_MS * MS
    step = clock.synchronise()
    assert (None if step is None else str(step)) == words
    assert clock.synchronise() is None, "it is told once"


def test_the_real_clock_measures_both_offsets():
    clock = Clock()
    assert clock.synchronise() is None
    assert clock.reading.offset_ns > 10**18
    assert clock.reading.suspended_ns >= 0


async def test_the_daemon_logs_a_step_once(tmp_path, monkeypatch):
    monkeypatch.setattr(supervisor, "HEALTH_PERIOD_S", 0.0)
    clock = SetClock(-5.0)
    clock.t_ns = STEP_AT_MS * MS
    published: asyncio.Queue[str] = asyncio.Queue()
    with zmq.Context() as context, closing(Publisher(context, f"ipc://{tmp_path}/publish", clock)) as publisher:
        publisher.add_listener(lambda topic, _: published.put_nowait(topic))
        with capture_logs() as logs:
            async with running(supervisor.HealthReporter(publisher, supervisor.Supervisor(), clock).run()):
                for _ in range(3):
                    assert await published.get() == "health"
    said = [one["event"] for one in logs]
    assert said == ["the wall clock was set back by 5.0 s; the control loop and recordings do not follow it"]
