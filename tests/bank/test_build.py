"""Building banks: the same bytes however it is done, nothing lost when killed, nothing damaged when it fails."""

import errno
import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from shearloop.bank.eit import bank_file
from shearloop.bank.eit.bank_file import MIN_SIGNAL_NORM, Bank, BankDefinition
from shearloop.bank.eit.build import RowJournal, RowSolver, build_bank
from shearloop.bank.eit.mesh import Mesh
from shearloop.bank.eit.models import conductivity
from shearloop.bank.errors import BankFileError, ConductivityError

MODEL = "gaussian_derivative"
K, SIGMA = np.linspace(0.4, 9.0, 5), np.linspace(0.3, 1.2, 4)


def defined(mesh: Mesh, sigma=SIGMA) -> BankDefinition:
    return BankDefinition(mesh.digest, MODEL, K, sigma)


# Builds the same bank in a process of its own, and waits for a line before it goes on after each row.
BUILDER = """
import sys
from pathlib import Path
from shearloop.bank.eit.build import build_bank
from tests.bank.conftest import small_fingertip
from tests.bank.test_build import defined

def on_row(done, total):
    print(done, flush=True)
    sys.stdin.readline()

if __name__ == "__main__":
    mesh = small_fingertip()
    build_bank(mesh, defined(mesh), Path(sys.argv[1]), jobs=int(sys.argv[2]), on_row=on_row)
"""


@pytest.fixture(scope="module")
def finished(fingertip, tmp_path_factory) -> Path:
    """Return a bank built in one go by one process."""
    path = tmp_path_factory.mktemp("finished") / "one.bank"
    build_bank(fingertip, defined(fingertip), path)
    return path


def build(mesh, path, **options):
    """Build the same bank and return the progress and the notices."""
    progress, notices = [], []
    build_bank(
        mesh,
        defined(mesh, options.pop("sigma", SIGMA)),
        path,
        on_row=lambda *state: progress.append(state),
        on_notice=notices.append,
        **options,
    )
    return progress, notices


def test_every_cell_is_the_difference_of_two_solutions_or_marked_not_valid(finished, fingertip, forward):
    bank = Bank.open(finished, verify=True)
    np.testing.assert_allclose(bank.homogeneous, forward.homogeneous(), rtol=1e-12)
    kinds = set()
    for i, k in enumerate(K):
        for j, sigma in enumerate(SIGMA):
            values = conductivity(fingertip, MODEL, k, sigma)
            assert bank.min_conductivity[i, j] == values.min()
            try:
                signal_ = forward.voltages(values) - forward.homogeneous()
            except ConductivityError:
                kinds.add("not positive")
                expected = None
            else:
                expected = signal_ if np.linalg.norm(signal_) >= MIN_SIGNAL_NORM else None
                kinds.add("signal" if expected is not None else "no signal")
            assert bank.valid[i, j] == (expected is not None)
            if expected is None:
                assert not bank.signals[i, j].any()
            else:
                np.testing.assert_allclose(bank.signals[i, j], expected, rtol=1e-6, atol=1e-9)
    assert kinds == {"signal", "no signal", "not positive"}


def test_threads_build_the_same_bytes(finished, fingertip, tmp_path):
    progress, notices = build(fingertip, tmp_path / "two.bank", jobs=2)
    assert (tmp_path / "two.bank").read_bytes() == finished.read_bytes()
    assert progress == [(done, len(K)) for done in range(len(K) + 1)]
    assert notices == []
    assert [each.name for each in tmp_path.iterdir()] == ["two.bank"]


@pytest.mark.parametrize("jobs", [1, 2])
def test_a_build_that_is_killed_goes_on_without_solving_a_row_again(finished, fingertip, tmp_path, jobs):
    path = tmp_path / "killed.bank"
    script = tmp_path / "builder.py"
    script.write_text(BUILDER)
    root = Path(__file__).parents[2]
    for round_ in range(2):
        with subprocess.Popen(
            [sys.executable, script, path, str(jobs)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env={**os.environ, "PYTHONPATH": str(root)},
            text=True,
        ) as builder:
            taken_over = int(builder.stdout.readline())
            assert taken_over == 2 * round_
            for _ in range(2):
                builder.stdin.write("go on\n")
                builder.stdin.flush()
                builder.stdout.readline()
            # It waits for a line now, with its rows on the disk.
            builder.send_signal(signal.SIGKILL)
    assert not path.exists()

    progress, notices = build(fingertip, path)
    assert progress == [(4, 5), (5, 5)]
    assert len(notices) == 1
    assert "killed.bank.part: resuming, 4 of 5 rows" in notices[0]
    assert path.read_bytes() == finished.read_bytes()
    assert sorted(each.name for each in tmp_path.iterdir()) == ["builder.py", "killed.bank"]


@pytest.fixture
def interrupted(fingertip, tmp_path):
    """Return where a bank was being built, with three rows in its journal, out of order."""
    path = tmp_path / "half.bank"
    definition = defined(fingertip)
    solver = RowSolver(fingertip, definition)
    with RowJournal(path, definition) as journal:
        for row in (3, 0, 4):
            journal.append(row, solver.solve(row))
    return path


@pytest.mark.parametrize("length", [0, 20, 40, -1])
def test_a_row_cut_off_or_damaged_anywhere_is_solved_again(finished, fingertip, interrupted, length):
    row = interrupted.with_name("half.bank.part") / "3.row"
    whole = row.read_bytes()
    row.write_bytes(whole[:length] if length >= 0 else whole[:-5] + bytes([whole[-5] ^ 1]) + whole[-4:])
    progress, _ = build(fingertip, interrupted)
    assert progress[0] == (2, 5)
    assert interrupted.read_bytes() == finished.read_bytes()


def test_the_rows_of_another_bank_are_not_reused_and_that_is_said(fingertip, interrupted):
    progress, notices = build(fingertip, interrupted, sigma=SIGMA + 0.1)
    assert progress[0] == (0, 5)
    assert len(notices) == 1
    assert "half.bank.part: its rows belong to another bank or are damaged, and are discarded" in notices[0]
    np.testing.assert_array_equal(Bank.open(interrupted, verify=True).sigma_grid, SIGMA + 0.1)


@pytest.mark.parametrize("foreign", ["a.bank.part", "a.bank.part/thesis"])
def test_a_foreign_file_in_the_journals_place_is_left_alone(fingertip, tmp_path, foreign):
    (tmp_path / foreign).parent.mkdir(exist_ok=True)
    (tmp_path / foreign).write_text("my thesis")
    with pytest.raises(BankFileError, match=r"a\.bank\.part is in the way: it is not the journal"):
        build(fingertip, tmp_path / "a.bank")
    assert (tmp_path / foreign).read_text() == "my thesis"


def test_two_builds_of_one_target_do_not_mix(fingertip, interrupted):
    definition = defined(fingertip)
    with (
        RowJournal(interrupted, definition),
        pytest.raises(BankFileError, match=r"half\.bank: another build is at work"),
    ):
        build(fingertip, interrupted)


def test_a_bank_that_found_no_room_on_the_disk_is_written_from_its_journal_later(
    finished, fingertip, tmp_path, monkeypatch
):
    path = tmp_path / "full.bank"

    def full(_):
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patched:
        patched.setattr(bank_file, "replace_file", full)
        with pytest.raises(BankFileError, match=r"full\.bank: the bank .*; make room and give the same command again"):
            build(fingertip, path)
    # Nothing is solved again.
    monkeypatch.setattr(RowSolver, "solve", None)
    build(fingertip, path)
    assert path.read_bytes() == finished.read_bytes()


def test_places_that_cannot_be_written_are_refused_before_anything_is_solved(fingertip, tmp_path):
    with pytest.raises(BankFileError, match="is a directory; give the name of a file in it"):
        build(fingertip, tmp_path)
    with pytest.raises(BankFileError, match=r"none/a\.bank\.part: the bank cannot be written: No such file"):
        build(fingertip, tmp_path / "none" / "a.bank")
