import zipfile
from dataclasses import replace

import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from shearloop.bank.errors import BankError, CalibrationError
from shearloop.bank.estimation import Calibration, EstimatorSession, TactileFrame, fit
from shearloop.bank.estimation.calibration import OutputModel, write_archive
from shearloop.bank.estimation.fitting_raw import CylinderGrip, fit_cylinders
from shearloop.bank.estimation.regressors import Ridge


@pytest.fixture(scope="module")
def saved(fused_calibration, tmp_path_factory):
    path = tmp_path_factory.mktemp("calibration") / "fused.cal"
    fused_calibration.save(path)
    return path


def test_the_same_calibration_is_the_same_bytes(saved, tmp_path):
    again = tmp_path / "again.cal"
    Calibration.load(saved).save(again)
    assert again.read_bytes() == saved.read_bytes()


def test_a_loaded_calibration_estimates_alike(fused_calibration, saved, recorded):
    trackers = [EstimatorSession(fused_calibration), EstimatorSession(Calibration.load(saved))]
    for t, x in zip(recorded.t_s[:120], recorded.channels, strict=False):
        one, other = (tracker.estimate(TactileFrame.of(float(t), x)) for tracker in trackers)
        assert one == other


@settings(max_examples=40, deadline=None)
@given(where=st.floats(0, 1), length=st.integers(1, 40), cut=st.booleans())
def test_damage_is_refused_by_name_or_does_no_harm(saved, tmp_path_factory, where, length, cut):
    content = saved.read_bytes()
    at = int(where * (len(content) - 1))
    spoilt = bytes(255 - byte for byte in content[at : at + length])
    path = tmp_path_factory.mktemp("damaged") / "x.cal"
    path.write_bytes(content[:at] if cut else content[:at] + spoilt + content[at + length :])
    try:
        loaded = Calibration.load(path)
    except BankError as error:
        told = str(error)
    else:
        # Bytes that nothing reads, such as a date in the directory of the zip.
        loaded.save(path)
        assert path.read_bytes() == content
        return
    assert str(path) in told


def test_foreign_and_stale_files_are_refused(tmp_path, fused_calibration):
    foreign = tmp_path / "foreign.cal"
    with zipfile.ZipFile(foreign, "w") as archive:
        archive.writestr("notes.txt", "hello")
    with pytest.raises(CalibrationError, match="no header"):
        Calibration.load(foreign)
    (tmp_path / "text.cal").write_text("not a zip")
    with pytest.raises(CalibrationError, match="not a calibration, or it is truncated"):
        Calibration.load(tmp_path / "text.cal")
    with pytest.raises(CalibrationError, match="cannot be read"):
        Calibration.load(tmp_path / "none.cal")
    stale = tmp_path / "stale.cal"
    write_archive(stale, {"channel_table": "0" * 64}, fused_calibration)
    with pytest.raises(CalibrationError, match="channel table 000000000000…, expected"):
        Calibration.load(stale)


@pytest.mark.parametrize("strength", [1e-6, 1.0])
def test_diameters_that_were_calibrated_on_single_frames_are_refused(tmp_path, fused_calibration, strength):
    """They loaded, and another grip of a tool of 10 mm was read as 21, and called certain."""
    weights = np.random.default_rng(0).normal(size=fused_calibration.scale.size)
    frames = weights + np.linspace(-1.0, 1.0, 30)[:, None] * weights
    grips = [CylinderGrip(mm, frames + mm * weights, frames + mm * weights) for mm in (10.0, 25.0, 40.0)]
    line, path = OutputModel(fit_cylinders(grips), None, np.zeros(0)), tmp_path / "several.cal"
    replace(fused_calibration, diameter=line).save(path)
    assert Calibration.load(path).diameter is not None
    ridge = Ridge.fit(np.concatenate([one.frames for one in grips]), np.repeat([10.0, 25.0, 40.0], 30), strength)
    older = replace(fused_calibration, diameter=replace(line, reader=replace(line.reader, head=ridge)))
    older.save(path)
    with pytest.raises(CalibrationError, match=r"several\.cal: .*older version, which read diameters.*calibrate again"):
        Calibration.load(path)
    # Without motion a diameter is read from each frame, as ever.
    replace(older, motion=None, guards=()).save(path)
    assert Calibration.load(path).diameter is not None


def test_what_cannot_be_kept_is_an_error(tmp_path):
    with pytest.raises(TypeError, match="cannot be kept"):
        write_archive(tmp_path / "x.cal", {}, {"a": 1})
    with pytest.raises(CalibrationError, match="choose another --out"):
        write_archive(tmp_path / "none" / "x.cal", {}, np.zeros(1))


def test_what_was_taken_on_somebodys_word_is_kept_and_older_files_do_not_tell(
    fused_calibration, recorded, sliced, tmp_path
):
    assert fused_calibration.vouched == ()
    assert fused_calibration.word == ""
    timed = fit("fused", [recorded], "a played rig", trust_times=True)
    assert timed.word == "for when its loads were measured (--load-late)"
    path, older = tmp_path / "new.cal", tmp_path / "older.cal"
    fit("regression", [sliced()], "slices", all_torques=True).save(path)
    assert Calibration.load(path).word == "that no torque will come beyond those of its slices (--all-torques)"
    with zipfile.ZipFile(path) as new, zipfile.ZipFile(older, "w") as written:
        header = yaml.safe_load(new.read("calibration.yaml"))
        del header["content"]["vouched"]
        written.writestr("calibration.yaml", yaml.safe_dump(header))
        for name in header["sha256"]:
            written.writestr(name, new.read(name))
    assert Calibration.load(older).vouched is None
    assert Calibration.load(older).word == ""


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("vouched", ["the moon"]),
        ("vouched", [["load times"]]),
        ("vouched", "load times"),
        ("kind", "volts"),
        ("sides", "r"),
    ],
)
def test_a_word_that_this_version_does_not_know_is_refused_where_it_is_read(fused_calibration, tmp_path, name, value):
    """One of a newer version ended `run` in a KeyError, and raw frames were taken for slices of another kind."""
    path, other = tmp_path / "own.cal", tmp_path / "other.cal"
    fused_calibration.save(path)
    with zipfile.ZipFile(path) as own, zipfile.ZipFile(other, "w") as written:
        header = yaml.safe_load(own.read("calibration.yaml"))
        header["content"][name] = value
        written.writestr("calibration.yaml", yaml.safe_dump(header))
        for member in header["sha256"]:
            written.writestr(member, own.read(member))
    with pytest.raises(CalibrationError, match=name):
        Calibration.load(other)
