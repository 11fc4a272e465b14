import os
from pathlib import Path

import numpy as np
import pytest
from mcap.writer import Writer

from shearloop.bank.eit.channels import line_of_channels
from shearloop.daemon.analysis.series import read_series
from shearloop.daemon.config import RecordingConfig, load_daemon_config
from shearloop.daemon.errors import UserError
from shearloop.daemon.recording import schema
from shearloop.daemon.recording.export import count_messages
from shearloop.daemon.recording.reader import read_recording
from shearloop.daemon.recording.recorder import daemon_identity
from shearloop.daemon.recording.replay import RecordedRun
from shearloop.daemon.recording.writer import RecordingWriter


def written(path, n=4):
    rng = np.random.default_rng(0)
    frames = line_of_channels(np.round(rng.uniform(0, 1, (n, 896)), 4))
    with RecordingWriter(path, "a bench", {"tool": "driver"}) as writer:
        for i, line in enumerate(frames):
            writer.add_frame("right", 1_700_000_000_000_000_000 + i * 540_000_000, 1_700_000_000_300_000_000 + i, line)
            writer.add_torque(1_700_000_000_100_000_000 + i, 0.01 * i)
    return frames


def test_a_recording_round_trips(tmp_path):
    frames = written(tmp_path / "a.mcap")
    found = read_recording(tmp_path / "a.mcap")
    assert found.source == "a bench"
    assert found.notes == {"tool": "driver"}
    np.testing.assert_array_equal(found.sides["right"].lines, frames)
    np.testing.assert_array_equal(np.diff(found.sides["right"].t_mid_ns), 540_000_000)
    np.testing.assert_array_equal(found.sides["right"].arrival_ns - 1_700_000_000_300_000_000, np.arange(4))
    np.testing.assert_allclose(found.torque_nm, 0.01 * np.arange(4))
    assert list(tmp_path.iterdir()) == [tmp_path / "a.mcap"]


def test_messages_out_of_order_are_sorted(tmp_path):
    with RecordingWriter(tmp_path / "a.mcap", "x") as writer:
        for t in (3, 1, 2):
            writer.add_torque(t, float(t))
    np.testing.assert_array_equal(read_recording(tmp_path / "a.mcap").torque_nm, [1, 2, 3])


def test_an_unfinished_recording_stays_partial(tmp_path):
    def interrupted():
        with RecordingWriter(tmp_path / "a.mcap", "x") as writer:
            writer.add_torque(1, 1.0)
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert [path.name for path in tmp_path.iterdir()] == ["a.mcap.partial"]
    assert read_recording(tmp_path / "a.mcap.partial").torque_nm.tolist() == [1.0]


@pytest.mark.parametrize("read", [read_recording, RecordedRun, count_messages])
def test_foreign_and_outdated_files_are_refused(tmp_path, monkeypatch, read):
    (tmp_path / "text.mcap").write_text("hello")
    with (tmp_path / "other.mcap").open("wb") as file:
        other = Writer(file)
        other.start()
        other.finish()
    for name, key, value in (("stale", "CHANNEL_TABLE_HASH", "0" * 64), ("old", "FORMAT_VERSION", "1")):
        with monkeypatch.context() as outdated:
            outdated.setattr(schema, key, value)
            written(tmp_path / f"{name}.mcap")
    for name, why in (
        ("text", r"text\.mcap: this is not an MCAP file"),
        ("other", "not a recording of shearloop"),
        ("none", "No such file"),
        ("stale", "channel table 000000000000…"),
        ("old", "format version 1, expected 2; record it again, or import it again"),
    ):
        with pytest.raises(UserError, match=why):
            read(tmp_path / f"{name}.mcap")


def test_an_unwritable_recording_is_an_error(tmp_path):
    with pytest.raises(UserError, match="choose another --out"):
        RecordingWriter(tmp_path / "no" / "where.mcap", "x")


def test_a_side_that_no_file_has_is_not_to_be_imported(tmp_path):
    written(tmp_path / "a.mcap")
    for side, cure in (("left", "import those files as well"), ("up", "name a side that it has")):
        with pytest.raises(UserError, match=f"has frames of right, not of {side}; {cure}"):
            read_series(tmp_path / "a.mcap", (side,))


def test_a_folder_name_that_is_not_utf8_is_an_error(config):
    recorded = RecordingConfig(folder=Path(os.fsdecode(b"caf\xe9")))
    with pytest.raises(
        UserError, match=r"not UTF-8 \(the folder of the recordings is 'caf\\udce9'\); choose another name"
    ):
        daemon_identity(load_daemon_config(config()).model_copy(update={"recording": recorded}))
