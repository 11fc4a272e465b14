"""The bench of peers: what it compares agrees, and ratios are of one turn."""

import numpy as np
import pytest

from benchmarks import peers
from shearloop.bank.eit.bank_file import Bank, BankDefinition, write_bank
from shearloop.daemon.workers import SerialExecutor
from tests.bank.conftest import small_fingertip


@pytest.fixture(scope="module")
def bank(tmp_path_factory) -> Bank:
    path = tmp_path_factory.mktemp("bank") / "a.bank"
    random, grid = np.random.default_rng(1), np.linspace(1.0, 2.0, 8)
    signals = random.normal(0.0, 0.05, (8, 8, 896)).astype(np.float32)
    definition = BankDefinition("ab" * 32, "gaussian_derivative", grid, grid)
    write_bank(path, definition, signals[0, 0], np.ones((8, 8)), np.ones((8, 8), bool), signals)
    return Bank.open(path)


def test_ratios_are_taken_turn_by_turn() -> None:
    seconds = {"own": [1.0, 2.0, 4.0], "peer": [3.0, 6.0, 12.0], "other": [1.0, 1.0, 1.0]}
    found = peers.ratios(seconds, "own", ("peer", "absent"))
    assert found == {"peer / own": {"median": 3.0, "low": 3.0, "high": 3.0, "n": 3}}


def test_methods_take_turns() -> None:
    calls: list[str] = []
    methods = {name: (lambda name=name: calls.append(name), 1) for name in ("a", "b")}
    found = peers.take_turns(methods, 3)
    assert calls == ["a", "b"] * 4, "once to warm up, then in turns"
    assert {name: len(each) for name, each in found.items()} == {"a": 3, "b": 3}


def test_the_fast_ways_give_what_the_slow_ones_give(bank, monkeypatch) -> None:
    monkeypatch.setattr(peers, "N_CELLS", 20)
    methods, error = peers.cell_methods(small_fingertip())
    assert 10 < error["cells"] <= 20
    assert error["largest"] < 1e-9
    one, two = methods["fast, one thread"][0](), np.vstack(methods["fast, two threads"][0]())
    np.testing.assert_array_equal(one, two)
    frames = peers.frames_of(bank, None)
    matches, same = peers.match_methods(bank, frames)
    assert same == peers.N_CHECKED
    quick, plain = (matches[name][0]() for name in ("zero lag, fast", "zero lag, numpy float32"))
    assert [bank.signals.shape[1] * each.cell[0] + each.cell[1] for each in quick] == plain


def test_two_processes_match_a_batch_as_one_does(bank, monkeypatch) -> None:
    frames = peers.frames_of(bank, None)[:5]
    parts: list[int] = []

    class Counted(SerialExecutor):
        def map(self, function, shared, items):
            parts.append(len(items))
            for number, found in super().map(function, shared, items):
                matcher = peers.MATCHERS[shared[0]].from_bank(bank)
                assert found == [matcher.match(one, runner_up=False) for one in items[number]]
                yield number, found

    monkeypatch.setattr(peers, "BATCH", 7)
    monkeypatch.setattr(peers, "ProcessExecutor", lambda _: Counted())
    found = peers.batches_a_minute(bank.path, frames, 2)
    assert list(found) == [f"{lags}, {n}" for lags in peers.MATCHERS for n in ("one process", "two processes")]
    assert parts == [2] * 6, "once to warm up, and twice in turn"


def test_fewer_than_five_turns_are_refused(monkeypatch, capsys) -> None:
    monkeypatch.setattr("sys.argv", ["peers", "--bank", "x", "--out", "y", "--turns", "4"])
    with pytest.raises(SystemExit):
        peers.main()
    assert "--turns must be 5 or more" in capsys.readouterr().err


def test_before_each_cold_match_others_have_had_the_caches(bank, monkeypatch) -> None:
    happened: list[str] = []

    class Others:
        def __iadd__(self, _: float) -> "Others":
            happened.append("others")
            return self

    class Matcher:
        def match(self, _: object) -> None:
            happened.append("match")

    for kind in (peers.PrunedMatcher, peers.PrunedZeroLagMatcher):
        monkeypatch.setattr(kind, "from_bank", lambda _: Matcher())
    monkeypatch.setattr(peers.np, "zeros", lambda _: Others())
    found = peers.cold_seconds(bank, np.ones((3, 896)), turns=2)
    assert [len(each) for each in found.values()] == [2] * 2
    assert happened == ["others", "match"] * (2 * 2 * 3)
