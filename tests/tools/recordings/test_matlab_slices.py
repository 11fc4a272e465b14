import io
import json
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from shearloop.daemon.messaging.messages import TOPICS, Message, wire_map
from shearloop.daemon.recorder import schema
from shearloop.daemon.recorder.writer import McapFile
from shearloop.errors import UserError
from shearloop.tools.recordings.matlab_import import read_diameter_slices, read_line, read_torque_slices
from shearloop.tools.recordings.slice_export import export_slices
from shearloop.tools.recordings.tables import RecordedTopics
from tests.sample_messages import sample

S = 1_000_000_000
PERIOD_S = 0.5


class Sweep:
    """What a daemon records while angles are held for five seconds each; the torque is in every channel."""

    def __init__(self, folder: Path, slices: str = "torque", *, tared: bool = True) -> None:
        self.path, self.t_s, self.slices = folder / "sweep.mcap", 0.0, slices
        self._file = McapFile(io.FileIO(folder / "sweep.mcap.partial", "w"))
        self._file.add_metadata(schema.METADATA, schema.basic_identity("a test"))
        self.rest = np.random.default_rng(0).uniform(0.05, 0.25, 1024)
        if tared:
            self.loop(step_name="tare")
            self.frames(0.0, 4.0)
            self.loop(step_name="grip")

    def loop(self, **changes: Any) -> None:
        state = {"phase": "running", "step_name": "twist", "hold": 0, "slices": self.slices}
        self._add("loop.state", {"source": "loop", **state, "torque_source": "load_cell", **changes})

    def frames(self, torque_nm: float, for_s: float, *, valid: bool = True, repeated: bool = False) -> None:
        end_s = self.t_s + for_s
        while self.t_s < end_s:
            self.t_s += PERIOD_S
            line = self.rest + torque_nm
            self._add("eit.frame.right", {"source": "right", "line": line, "repeated": repeated})
            self._add("load.torque", {"source": "load_cell", "torque_nm": torque_nm, "valid": valid})

    def hold(self, number: int, torque_nm: float, for_s: float = 5.0, **frames: bool) -> None:
        self.loop(hold=number)
        self.frames(torque_nm, for_s, **frames)
        self.loop()
        self.frames(0.0, 1.0)

    def gripped(self, diameter_mm: float) -> None:
        self._add("gripper.state", {"source": "gripper", "diameter_mm": diameter_mm})

    def export(self, out: Path) -> tuple[list[str], Counter[str]]:
        """End the experiment and the recording, and write its slices."""
        self.loop(phase="done")
        self._file.close(self.path)
        written, missed = export_slices(self.path, out, list(RecordedTopics(self.path).counts))
        return [path.name for path in written], missed

    def end_with(self, topic: str, **changes: Any) -> Path:
        """Add a message with any keys, end the recording, and return it."""
        self.t_s += PERIOD_S
        kind = TOPICS[schema.schema_name(topic)]
        content = json.loads(self._message_json(kind, {"source": "right"}))
        self._file.add(topic, round(self.t_s * S), round(self.t_s * S), json.dumps({**content, **changes}).encode())
        self._file.close(self.path)
        return self.path

    def _add(self, topic: str, content: dict[str, Any]) -> None:
        t_ns = round(self.t_s * S)
        self._file.add(topic, t_ns, t_ns, self._message_json(TOPICS[schema.schema_name(topic)], content))

    def _message_json(self, kind: type[Message], content: dict[str, Any]) -> bytes:
        t_ns = round(self.t_s * S)
        return schema.message_json(kind.topic, wire_map(sample(kind, t_mono_ns=t_ns, **content), t_ns / S, 0), 0)


def test_each_hold_becomes_a_slice_for_reproduce(tmp_path):
    sweep = Sweep(tmp_path)
    for number, torque_nm in enumerate((0.05, 0.1, 0.15), start=1):
        sweep.hold(number, torque_nm)
    written, missed = sweep.export(tmp_path)
    assert sorted(written) == [*(f"Data_Slice_{n}.mat" for n in (1, 2, 3)), "TorqueSlice.mat", "TorqueSliceHom.mat"]
    assert not missed
    slices = read_torque_slices(tmp_path / "torque_slices")
    np.testing.assert_allclose(slices.torque_nm, [0.05, 0.1, 0.15])
    np.testing.assert_allclose(slices.differences, np.tile(slices.torque_nm[:, None], 896), atol=1e-6)
    raw = read_line(tmp_path / "torque_slices" / "TorqueSlice.mat")
    rest = read_line(tmp_path / "torque_slices" / "TorqueSliceHom.mat")
    np.testing.assert_allclose(raw - rest, 0.15, atol=1e-6)


def test_the_homogeneous_frame_has_no_frame_that_was_acquired_beyond_the_tare_in_part(tmp_path):
    sweep = Sweep(tmp_path, tared=False)
    # A tool is taken out right before the step, and gripped right after it.
    sweep.frames(0.1, 2.0)
    # The step begins within the next frame, and ends within the last one.
    sweep.t_s += 0.75 * PERIOD_S
    sweep.loop(step_name="tare")
    sweep.t_s -= 0.75 * PERIOD_S
    sweep.frames(0.05, PERIOD_S)
    sweep.frames(0.0, 4.0)
    sweep.frames(0.05, PERIOD_S)
    sweep.t_s += 0.25 * PERIOD_S
    sweep.loop(step_name="grip")
    sweep.frames(0.1, 1.0)
    sweep.hold(1, 0.15)
    sweep.export(tmp_path)
    np.testing.assert_allclose(read_line(tmp_path / "torque_slices" / "TorqueSliceHom.mat"), sweep.rest, atol=1e-6)


def test_a_second_sweep_continues_the_numbers(tmp_path):
    for diameter_mm in (10.2, 20.4):
        sweep = Sweep(tmp_path, "diameter")
        sweep.gripped(diameter_mm)
        sweep.hold(1, 0.07)
        sweep.hold(2, 0.07)
        sweep.export(tmp_path)
    slices = read_diameter_slices(tmp_path / "diameter_slices")
    np.testing.assert_allclose(slices.diameter_mm, [10, 10, 20, 20])


def test_a_second_sweep_keeps_the_first_raw_frame(tmp_path):
    for torques_nm in ((0.05, 0.15), (0.1, 0.2)):
        sweep = Sweep(tmp_path)
        for number, torque_nm in enumerate(torques_nm, start=1):
            sweep.hold(number, torque_nm)
        sweep.export(tmp_path)
    folder = tmp_path / "torque_slices"
    np.testing.assert_allclose(read_torque_slices(folder).torque_nm, [0.05, 0.15, 0.1, 0.2])
    raw, rest = (read_line(folder / f"{name}.mat") for name in ("TorqueSlice", "TorqueSliceHom"))
    np.testing.assert_allclose(raw - rest, 0.15, atol=1e-6)


def test_frames_and_torques_are_smoothed_around_the_same_middle(tmp_path):
    """The gel relaxes while it is held: what is said of its frame has to be said of its torque."""
    sweep = Sweep(tmp_path)
    sweep.loop(hold=1)
    torques = 0.05 + 0.1 * np.exp(-np.arange(14) * PERIOD_S / 2.0)
    for torque_nm in torques.tolist():
        sweep.frames(torque_nm, PERIOD_S)
    sweep.loop()
    sweep.export(tmp_path)
    slices = read_torque_slices(tmp_path / "torque_slices")
    # The last frame is not whole within the hold; of the others nine around the middle count.
    weights = np.exp(-0.5 * (np.arange(-4, 5) / 1.8) ** 2)
    np.testing.assert_allclose(slices.differences[0], weights @ torques[2:11] / weights.sum(), rtol=1e-5)
    np.testing.assert_allclose(slices.torque_nm[0], slices.differences[0].mean(), rtol=0.02)


def test_the_frame_before_the_tare_is_not_homogeneous(tmp_path):
    sweep = Sweep(tmp_path, tared=False)
    sweep.frames(0.3, 4.0)
    sweep.t_s += 0.3 * PERIOD_S
    sweep.loop(step_name="tare")
    sweep.t_s -= 0.9 * PERIOD_S
    sweep.frames(0.3, PERIOD_S)
    sweep.frames(0.0, 4.0)
    sweep.loop(step_name="grip")
    sweep.hold(1, 0.1)
    sweep.export(tmp_path)
    np.testing.assert_allclose(read_torque_slices(tmp_path / "torque_slices").differences, 0.1, atol=1e-6)


def test_the_raw_frame_is_clipped_like_the_papers(tmp_path):
    sweep = Sweep(tmp_path)
    sweep.hold(1, 0.3)
    sweep.export(tmp_path)
    raw = read_line(tmp_path / "torque_slices" / "TorqueSlice.mat")
    assert raw.max() == pytest.approx(0.45)
    np.testing.assert_allclose(raw, np.minimum(sweep.rest + 0.3, 0.45), atol=1e-6)


def test_a_hold_with_a_safety_interruption_is_one_slice(tmp_path):
    sweep = Sweep(tmp_path)
    for phase, for_s in (("running", 2.0), ("held", 1.0), ("running", 2.0)):
        sweep.loop(hold=1, phase=phase)
        sweep.frames(0.1, for_s)
    sweep.loop()
    assert "Data_Slice_2.mat" not in sweep.export(tmp_path)[0]
    assert len(read_torque_slices(tmp_path / "torque_slices").torque_nm) == 1


@pytest.mark.parametrize(
    ("tared", "for_s", "frames", "reason"),
    [
        (False, 5.0, {}, "no `tare` step"),
        (True, 0.5, {}, "fewer than 3 frames"),
        (True, 5.0, {"repeated": True}, "fewer than 3 frames"),
        (True, 5.0, {"valid": False}, "or no torque"),
    ],
    ids=["no tare", "short hold", "repeated frames", "invalid load"],
)
def test_a_missed_slice_is_reported_with_its_reason(tmp_path, tared, for_s, frames, reason, ran):
    sweep = Sweep(tmp_path, tared=tared)
    sweep.hold(1, 0.1, for_s, **frames)
    assert not sweep.export(tmp_path)[0]
    arguments = ("--format", "slices", "--out", str(tmp_path / "out"))
    assert f"{sweep.path}: 1 hold without a slice:" in (said := ran("recording", "export", sweep.path, *arguments).err)
    assert reason in said


def test_slices_need_a_request_of_the_experiment(tmp_path):
    sweep = Sweep(tmp_path, "")
    sweep.hold(1, 0.1)
    with pytest.raises(UserError, match="need an experiment with the key `slices`"):
        sweep.export(tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_an_unwritable_folder_is_reported(tmp_path, mistake):
    sweep, out = Sweep(tmp_path), tmp_path / "out"
    sweep.hold(1, 0.1)
    sweep.export(tmp_path)
    out.mkdir()
    (out / "torque_slices").write_text("")
    said = mistake("recording", "export", sweep.path, "--format", "slices", "--out", out)
    assert f"{out}/torque_slices: the export cannot be written: " in said
