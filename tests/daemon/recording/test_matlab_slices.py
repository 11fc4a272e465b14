import errno
import os
import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from shearloop.bank.eit.channels import PAPER_TABLE
from shearloop.daemon.errors import UserError
from shearloop.daemon.recording.matlab import read_diameter_slices, read_line, read_torque_slices
from shearloop.daemon.recording.matlab_slices import SliceRecorder

S = 1_000_000_000
PERIOD_S = 0.5


def loop_state(t_s: float, **changes: Any) -> dict[str, Any]:
    return {
        "t_mono_ns": round(t_s * S),
        "phase": "running",
        "step_name": "twist",
        "hold": 0,
        "slices": "torque",
        "torque_source": "load_cell",
        **changes,
    }


class Sweep:
    """What a daemon publishes while angles are held for five seconds each; the torque is in every channel."""

    def __init__(self, folder: Path, slices: str = "torque", *, tared: bool = True) -> None:
        self.recorder, self.t_s, self.slices = SliceRecorder(folder, PAPER_TABLE), 0.0, slices
        self.rest = np.random.default_rng(0).uniform(0.05, 0.25, 1024)
        if tared:
            self._loop(step_name="tare")
            self.frames(0.0, 4.0)
            self._loop(step_name="grip")

    def _loop(self, **changes: Any) -> None:
        self.recorder("loop.state", loop_state(self.t_s, slices=self.slices, **changes))

    def frames(self, torque_nm: float, for_s: float, *, valid: bool = True, repeated: bool = False) -> None:
        end_s = self.t_s + for_s
        while self.t_s < end_s:
            self.t_s += PERIOD_S
            line = (self.rest + torque_nm).astype("<f4")
            frame = {
                "source": "right",
                "t_mono_ns": round(self.t_s * S),
                "channels": PAPER_TABLE.channels_of_line(line).astype("<f4").tobytes(),
                "line": line.tobytes(),
                "repeated": repeated,
            }
            self.recorder("eit.frame", frame)
            torque = {"t_mono_ns": round(self.t_s * S), "torque_nm": torque_nm, "valid": valid}
            self.recorder("load.torque", torque)

    def hold(self, number: int, torque_nm: float, for_s: float = 5.0, **frames: bool) -> None:
        self._loop(hold=number)
        self.frames(torque_nm, for_s, **frames)
        self._loop()
        self.frames(0.0, 1.0)

    def gripped(self, diameter_mm: float) -> None:
        self.recorder("gripper.state", {"diameter_mm": diameter_mm})

    def done(self) -> None:
        self._loop(phase="done")
        self.recorder.close()


def test_each_hold_becomes_a_slice_for_reproduce(tmp_path):
    sweep = Sweep(tmp_path)
    for number, torque_nm in enumerate((0.05, 0.1, 0.15), start=1):
        sweep.hold(number, torque_nm)
    sweep.done()
    slices = read_torque_slices(tmp_path / "torque_slices")
    np.testing.assert_allclose(slices.torque_nm, [0.05, 0.1, 0.15])
    np.testing.assert_allclose(slices.differences, np.tile(slices.torque_nm[:, None], 896), atol=1e-6)
    raw = read_line(tmp_path / "torque_slices" / "TorqueSlice.mat")
    rest = read_line(tmp_path / "torque_slices" / "TorqueSliceHom.mat")
    np.testing.assert_allclose(raw - rest, 0.15, atol=1e-6)
    assert sweep.recorder.summary == "3 torque slices"


def test_a_second_sweep_continues_the_numbers(tmp_path):
    for diameter_mm in (10.2, 20.4):
        sweep = Sweep(tmp_path, "diameter")
        sweep.gripped(diameter_mm)
        sweep.hold(1, 0.07)
        sweep.hold(2, 0.07)
        sweep.done()
    slices = read_diameter_slices(tmp_path / "diameter_slices")
    np.testing.assert_allclose(slices.diameter_mm, [10, 10, 20, 20])


def test_a_second_sweep_keeps_the_first_raw_frame(tmp_path):
    """One raw frame a run, of its largest torque; that of another run is nowhere else."""
    for torques_nm in ((0.05, 0.15), (0.1, 0.2)):
        sweep = Sweep(tmp_path)
        for number, torque_nm in enumerate(torques_nm, start=1):
            sweep.hold(number, torque_nm)
        sweep.done()
    folder = tmp_path / "torque_slices"
    np.testing.assert_allclose(read_torque_slices(folder).torque_nm, [0.05, 0.15, 0.1, 0.2])
    for suffix, torque_nm in (("", 0.15), ("_2", 0.2)):
        raw, rest = (read_line(folder / f"{name}{suffix}.mat") for name in ("TorqueSlice", "TorqueSliceHom"))
        np.testing.assert_allclose(raw - rest, torque_nm, atol=1e-6)
    assert sweep.recorder.summary == (
        "2 torque slices, their raw frame in TorqueSlice_2.mat (that of an earlier run stays in TorqueSlice.mat)"
    )


def test_frames_and_torques_are_smoothed_around_the_same_middle(tmp_path):
    """The gel relaxes while it is held: what is said of its frame has to be said of its torque."""
    sweep = Sweep(tmp_path)
    sweep._loop(hold=1)
    torques = 0.05 + 0.1 * np.exp(-np.arange(14) * PERIOD_S / 2.0)
    for torque_nm in torques.tolist():
        sweep.frames(torque_nm, PERIOD_S)
    sweep._loop()
    sweep.frames(0.0, 1.0)
    sweep.done()
    slices = read_torque_slices(tmp_path / "torque_slices")
    # The last frame is not whole within the hold; of the others nine around the middle count.
    weights = np.exp(-0.5 * (np.arange(-4, 5) / 1.8) ** 2)
    np.testing.assert_allclose(slices.differences[0], weights @ torques[2:11] / weights.sum(), rtol=1e-5)
    np.testing.assert_allclose(slices.torque_nm[0], slices.differences[0].mean(), rtol=0.02)


def test_the_frame_before_the_tare_is_not_homogeneous(tmp_path):
    sweep = Sweep(tmp_path, tared=False)
    sweep.frames(0.3, 4.0)
    sweep.t_s += 0.3 * PERIOD_S
    sweep._loop(step_name="tare")
    sweep.t_s -= 0.9 * PERIOD_S
    sweep.frames(0.3, PERIOD_S)
    sweep.frames(0.0, 4.0)
    sweep._loop(step_name="grip")
    sweep.hold(1, 0.1)
    sweep.done()
    np.testing.assert_allclose(read_torque_slices(tmp_path / "torque_slices").differences, 0.1, atol=1e-6)


def test_frames_of_a_hold_may_arrive_after_its_end(tmp_path):
    sweep = Sweep(tmp_path)
    sweep._loop(hold=1)
    sweep.frames(0.1, 1.0)
    begun_s, sweep.t_s = sweep.t_s, sweep.t_s + 2.5
    sweep._loop()
    sweep._loop(step_name="turn_to")
    sweep.t_s = begun_s
    sweep.frames(0.1, 3.5)
    sweep.done()
    assert sweep.recorder.diagnostics()["slices"] == 1, sweep.recorder.summary


def test_the_raw_frame_is_clipped_like_the_papers(tmp_path):
    sweep = Sweep(tmp_path)
    sweep.hold(1, 0.3)
    sweep.done()
    raw = read_line(tmp_path / "torque_slices" / "TorqueSlice.mat")
    assert raw.max() == pytest.approx(0.45)
    np.testing.assert_allclose(raw, np.minimum(sweep.rest + 0.3, 0.45), atol=1e-6)


def test_closing_writes_the_last_slice(tmp_path):
    sweep = Sweep(tmp_path)
    sweep._loop(hold=1)
    sweep.frames(0.1, 5.0)
    sweep._loop()
    sweep.recorder.close()
    assert sweep.recorder.diagnostics()["slices"] == 1


def test_a_hold_with_a_safety_interruption_is_one_slice(tmp_path):
    sweep = Sweep(tmp_path)
    for phase, for_s in (("running", 2.0), ("held", 1.0), ("running", 2.0)):
        sweep._loop(hold=1, phase=phase)
        sweep.frames(0.1, for_s)
    sweep._loop()
    sweep.done()
    assert sweep.recorder.diagnostics()["slices"] == 1


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
def test_a_missed_slice_is_counted_with_its_reason(tmp_path, tared, for_s, frames, reason):
    sweep = Sweep(tmp_path, tared=tared)
    sweep.hold(1, 0.1, for_s, **frames)
    sweep.done()
    assert sweep.recorder.diagnostics()["slices"] == 0
    assert reason in sweep.recorder.summary


def test_slices_need_a_request_of_the_experiment(tmp_path):
    sweep = Sweep(tmp_path, "")
    sweep.hold(1, 0.1)
    sweep.done()
    assert list(tmp_path.iterdir()) == []


def test_a_folder_that_cannot_be_made_is_an_error(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(UserError, match="cannot be made"):
        SliceRecorder(tmp_path / "file" / "slices", PAPER_TABLE)


@pytest.fixture(params=["full", "gone"])
def unwritable(request, tmp_path, monkeypatch) -> Path:
    """Return a folder in which nothing can be written, or not to its end."""
    if request.param == "gone":
        # Whoever runs the tests may write everywhere, but in no folder that is none.
        (tmp_path / "torque_slices").write_text("")
    else:

        def full(_descriptor: int) -> None:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

        monkeypatch.setattr("shearloop.files.os.fsync", full)
    return tmp_path


def test_an_unwritable_folder_is_reported(unwritable):
    sweep = Sweep(unwritable)
    sweep.hold(1, 0.1)
    sweep.hold(2, 0.1)
    sweep.done()
    assert f"no slice was kept; 2 missed: {unwritable} cannot be written (" in sweep.recorder.summary
    facts = sweep.recorder.diagnostics()
    assert facts["slices"] == 0
    assert list(facts["errors"].values()) == [2]
    assert "cannot be written" in str(facts["error"])
    assert not list(unwritable.glob("torque_slices/*")), "nothing half written is left"


def test_messages_do_not_wait_for_the_disk(tmp_path, monkeypatch):
    let_go, threads = threading.Event(), set()

    def slow(_file: object, _arrays: object) -> None:
        threads.add(threading.current_thread())
        assert let_go.wait(60)

    monkeypatch.setattr("shearloop.daemon.recording.matlab_slices.savemat", slow)
    sweep = Sweep(tmp_path)
    sweep.hold(1, 0.1)
    sweep.hold(2, 0.1)
    assert sweep.recorder.diagnostics()["slices"] == 0, "and the messages have been heard"
    let_go.set()
    sweep.done()
    assert sweep.recorder.diagnostics()["slices"] == 2
    assert threads.isdisjoint({threading.current_thread()})
