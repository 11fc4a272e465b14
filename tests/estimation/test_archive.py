import io
import os
import re
import tracemalloc
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from shearloop.bank.channels import PAPER_TABLE
from shearloop.bank.errors import BankError, CalibrationError
from shearloop.estimation import TRUSTED, Calibration, fit
from shearloop.estimation.bank_estimators import BankEstimator, PaperEstimator
from shearloop.estimation.channel_imputer import ChannelImputer
from shearloop.estimation.estimator import Regression
from shearloop.estimation.reconstruction import Reconstruction
from tests.estimation.conftest import follow
from tests.paper_curve import paper_curve


@pytest.fixture(scope="module")
def saved(motion_calibration, tmp_path_factory):
    path = tmp_path_factory.mktemp("calibration") / "fused.cal"
    motion_calibration.save(path)
    return path


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    """A calibration of the paper's torque alone."""
    path = tmp_path_factory.mktemp("calibration") / "paper.cal"
    sigma = np.linspace(1.3, 1.9, 20)
    paper_curve("ab" * 32, torque=(sigma, 0.4 - 0.2 * sigma)).save(path)
    return path


def test_the_same_calibration_is_the_same_bytes(saved, tmp_path):
    again = tmp_path / "again.cal"
    Calibration.load(saved).save(again)
    assert again.read_bytes() == saved.read_bytes()


def test_a_loaded_calibration_estimates_alike(motion_calibration, saved, recorded):
    part = recorded.between(0, 120)
    assert follow(Calibration.load(saved), part) == follow(motion_calibration, part)


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
        message = str(error)
    else:
        # Bytes that nothing reads, such as a date in the directory of the zip.
        loaded.save(path)
        assert path.read_bytes() == content
        return
    assert str(path) in message


def test_foreign_and_stale_files_are_refused(tmp_path, small):
    foreign = tmp_path / "foreign.cal"
    with zipfile.ZipFile(foreign, "w") as archive:
        archive.writestr("notes.txt", "hello")
    with pytest.raises(CalibrationError, match="not a calibration"):
        Calibration.load(foreign)
    (tmp_path / "text.cal").write_text("not a zip")
    with pytest.raises(CalibrationError, match="not a calibration, or it is truncated"):
        Calibration.load(tmp_path / "text.cal")
    with pytest.raises(CalibrationError, match="cannot be read"):
        Calibration.load(tmp_path / "none.cal")
    for find, new, message in (
        (PAPER_TABLE.digest, f"'{'0' * 64}'", "channel table 000000000000…, expected"),
        ("format_version: 11", "format_version: 9", "format version 9, expected 11; calibrate again"),
    ):
        with pytest.raises(CalibrationError, match=message):
            Calibration.load(edited(small, tmp_path / "stale.cal", find, new))


def rewritten(whole, path, change):
    """Write a calibration's file with other contents of its members; change(name, content) returns the new one."""
    with zipfile.ZipFile(whole) as read, zipfile.ZipFile(path, "w") as written:
        for member in read.namelist():
            written.writestr(member, change(member, read.read(member)))
    return path


def edited(whole, path, find, new):
    """Write a calibration whose header has another text."""

    def changed(member, content):
        assert member != "calibration.yaml" or content.decode().count(find) == 1
        return content.replace(find.encode(), new.encode()) if member == "calibration.yaml" else content

    return rewritten(whole, path, changed)


def test_members_that_would_fill_the_memory_are_refused(tmp_path):
    large = tmp_path / "large.cal"
    with zipfile.ZipFile(large, "w", zipfile.ZIP_DEFLATED) as archive, archive.open("a.npy", "w") as member:
        for _ in range(200):
            member.write(bytes(1 << 20))
    tracemalloc.start()
    with pytest.raises(CalibrationError, match="its members are larger than the file, or compressed"):
        Calibration.load(large)
    assert tracemalloc.get_traced_memory()[1] < 16e6
    tracemalloc.stop()


def test_an_array_without_its_data_is_refused(tmp_path):
    text = io.BytesIO()
    np.lib.format.write_array_header_1_0(text, {"descr": "<f8", "fortran_order": False, "shape": (10**15,)})
    hollow = tmp_path / "hollow.cal"
    with zipfile.ZipFile(hollow, "w") as archive:
        archive.writestr("a.npy", text.getvalue())
    with pytest.raises(CalibrationError, match=r"truncated or damaged .*; calibrate again"):
        Calibration.load(hollow)


def test_values_that_cannot_be_kept_and_files_that_cannot_be_written_are_errors(tmp_path, motion_calibration):
    with pytest.raises(TypeError, match="cannot be kept"):
        replace(motion_calibration, source={"a": 1}).save(tmp_path / "x.cal")
    with pytest.raises(CalibrationError, match="choose another path"):
        motion_calibration.save(tmp_path / "none" / "x.cal")


def test_a_file_of_version_0_3_0_loads_without_what_it_does_not_hold(saved, motion_calibration, recorded, tmp_path):
    def older(member, content):
        if member != "calibration.yaml":
            return content
        header = yaml.safe_load(content)
        del header["content"]["learned"], header["content"]["torque"]["regressor"]["drift"]
        return yaml.safe_dump(header, sort_keys=False).encode()

    loaded = Calibration.load(rewritten(saved, tmp_path / "older.cal", older))
    assert not loaded.learned.complete
    assert not len(loaded.learned.digests)
    assert loaded.gain_regressor().gain.drift == 0.0
    part = recorded.between(0, 120)
    assert follow(loaded, part) == follow(motion_calibration, part)


def test_assumptions_are_kept(motion_calibration, recorded, tmp_path):
    assert motion_calibration.assumptions == ()
    one_way = "no torque is negative, because its recordings have positive torques alone"
    assert (motion_calibration.only_sign, motion_calibration.assumption_text) == (1, one_way)
    timed = fit("motion_regression", [recorded], "an emulated rig", timing=TRUSTED)
    assert timed.assumption_text == f"the load cell's delay is as given (--load-cell-delay-s) and {one_way}"
    path = tmp_path / "new.cal"
    timed.save(path)
    assert Calibration.load(path).assumptions == timed.assumptions


BOMB = "".join(f"a{i}: &a{i} [{', '.join([f'*a{i - 1}' if i else 'x'] * 10)}]\n" for i in range(9))


@pytest.mark.parametrize("key", ["kind", "format_version", "channel_table", "content"])
def test_aliases_that_would_fill_the_memory_are_refused(key, tmp_path):
    bomb = tmp_path / "bomb.cal"
    with zipfile.ZipFile(bomb, "w") as archive:
        archive.writestr("calibration.yaml", f"{BOMB}{key}: *a8\n")
    tracemalloc.start()
    with pytest.raises(CalibrationError, match="with every alias written out") as refused:
        Calibration.load(bomb)
    assert "\n" not in str(refused.value)
    assert tracemalloc.get_traced_memory()[1] < 16e6
    tracemalloc.stop()


@pytest.mark.parametrize(
    ("find", "new", "problem"),
    [
        ("bank_identity: ", "bank_identity: null #", "bank_identity is None"),
        ("offset: ", "offset: .nan #", "offset is nan"),
        ("offset: ", "offset: .inf #", "no finite value"),
        ("offset: ", "offset: 'abc' #", "offset is 'abc'"),
        ("low: ", "low: .nan #", "low is nan"),
        ("recordings: 3", "recordings: 4.5", "recordings is 4.5, expected a value of type int"),
        ("sides: []", "sides: 5", "sides is not a list"),
        ("sides: []", "sides: r", "sides is not a list"),
        ("sides: []", "sides: [right, left]", "its arrays have other shapes"),
        ("assumptions: []", "assumptions: [the moon]", "assumptions/0 is 'the moon', which this version does not know"),
        ("assumptions: []", "assumptions: [[load timing]]", "assumptions/0 is"),
        ("assumptions: []", "assumptions: load timing", "assumptions is not a list"),
    ],
)  # fmt: skip
def test_a_header_with_a_wrong_value_is_refused(small, find, new, problem, tmp_path):
    with pytest.raises(CalibrationError, match=problem):
        Calibration.load(edited(small, tmp_path / "x.cal", find, new))


@pytest.mark.parametrize(
    "array",
    [
        "scale",
        "torque.regressor.mean_feature",
        "validators.0.noise",
        "torque.regressor.point.weights",
        "learned.digests",
    ],
)
@pytest.mark.parametrize(
    "change",
    [
        lambda a: np.full(a.shape, "abc"),
        lambda a: np.full(a.shape, np.nan),
        lambda a: a.astype(np.complex128),
        lambda a: a.astype(np.int8),
        lambda _: np.ones(7),
        lambda _: np.ones((2, 3, 4)),
        lambda _: np.array(1.0),
    ],
    ids=["text", "nan", "complex", "small integers", "7 values", "three dimensions", "no dimension"],
)
def test_an_array_of_another_type_or_shape_is_refused(saved, array, change, tmp_path):
    seen = []

    def changed(member, content):
        seen.append(member)
        if member != f"{array}.npy":
            return content
        np.save(file := io.BytesIO(), change(np.load(io.BytesIO(content))))
        return file.getvalue()

    with pytest.raises(CalibrationError, match="does not describe a calibration of this version"):
        Calibration.load(rewritten(saved, tmp_path / "x.cal", changed))
    assert f"{array}.npy" in seen


@pytest.mark.parametrize("change", ["fewer lags", "other channels"])
def test_arrays_that_fit_each_other_and_not_the_channel_table_are_refused(motion_calibration, change, tmp_path):
    estimator = motion_calibration.estimator
    temporal = estimator.temporal
    if change == "fewer lags":
        changed = replace(temporal, edges=temporal.edges[:-1])
    else:
        changed = replace(temporal, directions=temporal.directions[:, :, :-1].copy())
    replace(motion_calibration, estimator=replace(estimator, temporal=changed)).save(tmp_path / "x.cal")
    with pytest.raises(CalibrationError, match="does not describe a calibration of this version"):
        Calibration.load(tmp_path / "x.cal")


def imputer(channels: int) -> ChannelImputer:
    return ChannelImputer(np.zeros((1, channels)), np.zeros((2, 1, channels)), np.ones((1, channels)))


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (Regression, "inputs, expected 1792"),
        (lambda scale: Regression(scale, imputer=imputer(895)), "for dead channels are not of 2 sides of 896"),
        (lambda scale: Reconstruction(scale, image=np.ones((50, 895))), "expected pixels of 896 channels"),
        (lambda scale: Reconstruction(scale, image=np.ones((50, 896))), "inputs, expected 100"),
        (BankEstimator, "inputs, expected 8"),
        (PaperEstimator, "inputs, expected 2"),
    ],
    ids=["regression", "imputer", "image", "pixels", "bank", "paper"],
)
def test_each_estimator_refuses_arrays_of_other_channels(motion_calibration, make, said, tmp_path):
    estimator = make(motion_calibration.estimator.scale)
    replace(motion_calibration, estimator=estimator).save(tmp_path / "x.cal")
    with pytest.raises(CalibrationError, match=said):
        Calibration.load(tmp_path / "x.cal")


@pytest.mark.parametrize("method", [zipfile.ZIP_DEFLATED, zipfile.ZIP_LZMA, zipfile.ZIP_BZIP2])
def test_compressed_and_encrypted_members_are_refused(small, method, tmp_path):
    packed = tmp_path / "packed.cal"
    with zipfile.ZipFile(small) as read, zipfile.ZipFile(packed, "w", method) as written:
        for member in read.namelist():
            written.writestr(member, read.read(member))
    content = packed.read_bytes().replace(b"\x93NUMPY", b"\x00NUMPY")
    packed.write_bytes(bytes(len(small.read_bytes())) + content)
    with pytest.raises(CalibrationError, match="or compressed"):
        Calibration.load(packed)
    encrypted = bytearray(small.read_bytes())
    for mark, flags in ((b"PK\x01\x02", 8), (b"PK\x03\x04", 6)):
        for at in (one.start() for one in re.finditer(mark, encrypted)):
            encrypted[at + flags] |= 1
    packed.write_bytes(encrypted)
    with pytest.raises(CalibrationError, match="encrypted"):
        Calibration.load(packed)


@pytest.mark.parametrize("kind", ["device", "pipe", "large"])
def test_a_file_without_an_end_is_not_read(kind, tmp_path):
    path = tmp_path / "x.cal" if kind != "device" else Path("/dev/zero")
    if kind == "pipe":
        os.mkfifo(path)
    if kind == "large":
        with zipfile.ZipFile(path, "w") as archive:
            archive.writestr("calibration.yaml", bytes(65 << 20))
    with pytest.raises(
        CalibrationError, match="larger than 64 MB" if kind == "large" else "a device or a pipe; name a"
    ):
        Calibration.load(path)
