"""The bank file: it reads back as written, and damaged files are refused with the cure."""

import hashlib
import json
import math
import os
import re
from dataclasses import replace

import numpy as np
import pytest

from shearloop.bank.bank_file import FORMAT_VERSION, Bank, BankDefinition, write_bank
from shearloop.bank.channels import PAPER_TABLE
from shearloop.bank.errors import BankFileError, ModelError

GEOMETRY = "ab" * 32
DEFINITION = BankDefinition(GEOMETRY, "gaussian_derivative", np.linspace(1, 2, 4), np.linspace(0.5, 2.5, 3))
CURE = "build it with `shearloop bank build"


def write(path, **changed):
    rng = np.random.default_rng(5)
    signals = rng.normal(size=(4, 3, 896)).astype(np.float32)
    defined = replace(DEFINITION, **changed)
    write_bank(path, defined, np.arange(896.0), rng.normal(size=(4, 3)), np.eye(4, 3, dtype=bool), signals)
    return signals


@pytest.fixture
def path(tmp_path):
    write(tmp_path / "small.bank")
    return tmp_path / "small.bank"


def write_header(path, text):
    """Write another header and put its checksum right again, as an honest writer of another kind would."""
    content, text = bytearray(path.read_bytes()), text.ljust(4048)
    content[16:48], content[48:4096] = hashlib.sha256(text).digest(), text
    path.write_bytes(content)


def rewrite_header(path, change):
    """Change the header's JSON."""
    write_header(path, json.dumps(change(json.loads(path.read_bytes()[48:4096]))).encode())


def rewrite_array(path, name, change):
    """Put another array in the place of one, with its shape and checksum."""
    content = bytearray(path.read_bytes())
    old = json.loads(content[48:4096])["arrays"][name]
    stored = np.frombuffer(content, old["type"], math.prod(old["shape"]), old["offset"]).reshape(old["shape"])
    changed = np.ascontiguousarray(change(stored), old["type"])
    new = old | {"shape": changed.shape, "sha256": hashlib.sha256(changed.tobytes()).hexdigest()}
    content[old["offset"] : old["offset"] + changed.nbytes] = changed.tobytes()
    path.write_bytes(content)
    rewrite_header(path, lambda header: header | {"arrays": header["arrays"] | {name: new}})


def test_what_is_written_is_read_back(path):
    signals = write(path)
    bank = Bank.open(path)
    np.testing.assert_array_equal(bank.signals, signals)
    np.testing.assert_array_equal(bank.homogeneous, np.arange(896.0))
    np.testing.assert_array_equal(bank.valid, np.eye(4, 3, dtype=bool))
    np.testing.assert_array_equal(bank.k_grid, np.linspace(1, 2, 4))
    np.testing.assert_array_equal(bank.sigma_grid, np.linspace(0.5, 2.5, 3))
    assert bank.min_conductivity.dtype == np.float64
    assert (bank.model, bank.geometry_hash) == ("gaussian_derivative", GEOMETRY)
    assert bank.identity == DEFINITION.identity
    assert list(path.parent.iterdir()) == [path]


def test_signals_are_mapped_from_a_page_and_nothing_can_be_written(path):
    bank = Bank.open(path)
    assert isinstance(bank.signals, np.memmap)
    assert bank.signals.dtype == np.dtype("<f4")
    assert bank.signals.offset % 4096 == 0
    assert bank.signals.nbytes + bank.signals.offset == path.stat().st_size
    for array in (bank.signals, bank.homogeneous, bank.min_conductivity, bank.valid, bank.k_grid):
        assert not array.flags.writeable


def test_the_identity_is_of_all_that_defines_a_bank_and_of_nothing_else():
    same = replace(DEFINITION, k_grid=np.linspace(1, 2, 4) * (1 + 1e-15))
    assert same.identity == DEFINITION.identity
    assert DEFINITION.identity == "35e76cdeb12d079dcbdf6b9dae2c8ba8545557cd3e00a3a74305a9f2d7cd8915"
    others = [
        replace(DEFINITION, geometry_hash="cd" * 32),
        replace(DEFINITION, model="modulated_gaussian"),
        replace(DEFINITION, k_grid=np.linspace(1, 2.001, 4)),
        replace(DEFINITION, sigma_grid=np.linspace(0.5, 2.5, 4)),
    ]
    assert len({each.identity for each in [same, *others]}) == 5


def test_a_cut_anywhere_is_refused(path):
    whole = path.read_bytes()
    for length in (0, 5, 100, 4095, 4096, 5000, len(whole) - 1):
        path.write_bytes(whole[:length])
        with pytest.raises(BankFileError, match=r"small\.bank: .*(truncated|not a bank).*expected") as refused:
            Bank.open(path)
        # What does not begin as a bank may be anything, and is not to be written over.
        assert (CURE if length > 5 else "or make one with") in str(refused.value)
    path.write_bytes(whole + b"\0")
    with pytest.raises(BankFileError, match=f"expected {len(whole)} bytes, found {len(whole) + 1}"):
        Bank.open(path)


def test_every_flipped_byte_is_found(path):
    whole = path.read_bytes()
    arrays = json.loads(whole[48:4096])["arrays"]
    sizes = {name: math.prod(a["shape"]) * int(a["type"][-1]) for name, a in arrays.items()}
    used = [range(4096)] + [range(a["offset"], a["offset"] + sizes[name]) for name, a in arrays.items()]
    rng = np.random.default_rng(1)
    for position in [int(rng.choice(positions)) for positions in used for _ in range(8)]:
        damaged = bytearray(whole)
        damaged[position] ^= 0x10
        path.write_bytes(damaged)
        with pytest.raises(BankFileError, match=r"small\.bank: "):
            Bank.open(path)


@pytest.mark.parametrize("definition", ["banks/mine.yaml", "mine.yaml", "../config/banks/mine.yaml"])
def test_a_missing_bank_names_its_definition(definition, tmp_path):
    named = tmp_path / "run" / definition
    named.parent.resolve().mkdir(parents=True, exist_ok=True)
    named.resolve().write_text("")
    bank = tmp_path / "run" / "mine.bank"
    build = f"shearloop bank build --config {named.resolve()} --out {bank}`"
    with pytest.raises(BankFileError, match=f"{re.escape(build)}$"):
        Bank.open(bank)


def test_foreign_files_other_formats_and_other_channel_tables_are_refused(path, tmp_path):
    with pytest.raises(BankFileError, match=r"none\.bank: the bank cannot be read: No such file.*shearloop bank build"):
        Bank.open(tmp_path / "none.bank")
    with pytest.raises(BankFileError, match="cannot be read: it is a folder; name a file in it"):
        Bank.open(tmp_path)
    (tmp_path / "foreign.bank").write_bytes(b"\x89HDF\r\n" * 2000)
    with pytest.raises(BankFileError, match=r"foreign\.bank: this is not a bank: expected"):
        Bank.open(tmp_path / "foreign.bank")

    rewrite_header(path, lambda header: header | {"channel_table": "0123456789abcdef"})
    with pytest.raises(BankFileError, match=f"channel table 0123456789ab…, expected {PAPER_TABLE.digest[:12]}…"):
        Bank.open(path)
    write(path)
    content = bytearray(path.read_bytes())
    content[8] = 77
    path.write_bytes(content)
    with pytest.raises(BankFileError, match=f"has format version 77, expected {FORMAT_VERSION}"):
        Bank.open(path)


@pytest.mark.parametrize(
    "change",
    [
        lambda header: [header],
        lambda header: {name: value for name, value in header.items() if name != "arrays"},
        lambda header: header | {"arrays": {}},
        lambda header: header | {"model": "square"},
        lambda header: header | {"geometry": "ef" * 32},
        lambda header: header | {"arrays": header["arrays"] | {"valid": header["arrays"]["valid"] | {"shape": [-1]}}},
        lambda header: header | {"arrays": header["arrays"] | {"k_grid": header["arrays"]["k_grid"] | {"offset": -9}}},
    ],
)
def test_a_header_that_describes_no_bank_is_refused(path, change):
    rewrite_header(path, change)
    with pytest.raises(BankFileError, match=CURE):
        Bank.open(path)


@pytest.mark.parametrize("text", [b"{not JSON", b"[" * 4000, b"\xff\xfe", b"9" * 4048])
def test_a_header_that_is_no_json_is_refused(path, text):
    write_header(path, text)
    with pytest.raises(BankFileError, match="its header does not describe a bank"):
        Bank.open(path)


@pytest.mark.parametrize(
    ("name", "change", "problem"),
    [
        ("signals", lambda a: a.reshape(12, 896), "the shape (12, 896), expected (4, 3, 896)"),
        ("signals", lambda a: a.reshape(3, 4, 896), "the shape (3, 4, 896), expected (4, 3, 896)"),
        ("homogeneous", lambda a: a[:3], "the shape (3,), expected (896,)"),
        ("valid", lambda a: a[:2, :2], "the shape (2, 2), expected (4, 3)"),
        ("signals", lambda a: np.where(a > 0, a, np.nan), "values that are not finite"),
        ("homogeneous", lambda a: np.full_like(a, np.inf), "values that are not finite"),
        ("min_conductivity", lambda a: np.full_like(a, np.nan), "values that are not finite"),
    ],
)
def test_an_array_of_another_shape_or_without_numbers_is_refused(path, name, change, problem):
    rewrite_array(path, name, change)
    with pytest.raises(BankFileError, match=re.escape(f"{name} has {problem}")):
        Bank.open(path)


def test_a_pipe_is_not_read(tmp_path):
    os.mkfifo(tmp_path / "a.bank")
    with pytest.raises(BankFileError, match="a device or a pipe; name a file"):
        Bank.open(tmp_path / "a.bank")


def test_a_failed_write_leaves_the_old_bank_and_no_debris(path, monkeypatch):
    before = path.read_bytes()

    def full(_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(BankFileError, match=r"small\.bank: the bank cannot be written: No space left"):
        write(path, model="linear")
    assert path.read_bytes() == before
    assert list(path.parent.iterdir()) == [path]


@pytest.mark.parametrize(
    ("changed", "sentence"),
    [
        ({"model": "square"}, "no basis model 'square'"),
        ({"k_grid": np.array([1.0, 1.0])}, "k grid must be finite numbers that ascend"),
        ({"sigma_grid": np.array([])}, "sigma grid must be"),
        ({"k_grid": np.array([1.0, np.inf])}, "finite"),
        ({"sigma_grid": np.array([0.0, 1.0])}, "sigma must be above 0 for the model gaussian_derivative, not 0"),
    ],
)
def test_definitions_that_make_no_bank_are_refused(changed, sentence):
    with pytest.raises(ModelError, match=sentence):
        replace(DEFINITION, **changed)
