"""The bench of matching_speed: what it compares agrees, and methods take turns."""

import numpy as np
import pytest

from benchmarks import matching_speed
from shearloop.bank.eit.bank_file import Bank
from tests.bank.conftest import small_fingertip


@pytest.fixture(scope="module")
def bank(tiny_bank) -> Bank:
    return Bank.open(tiny_bank)


def test_methods_take_turns():
    calls: list[str] = []
    methods = {name: (lambda name=name: calls.append(name), 1) for name in ("a", "b")}
    found = matching_speed.take_turns(methods, 3)
    assert calls == ["a", "b"] * 4, "once to warm up, then in turns"
    assert {name: len(each) for name, each in found.items()} == {"a": 3, "b": 3}


def test_fast_solvers_and_matchers_agree_with_slow_ones(bank, monkeypatch):
    monkeypatch.setattr(matching_speed, "N_CELLS", 20)
    methods, error = matching_speed.cell_methods(small_fingertip())
    assert 0 < error < 1e-9
    one, two = methods["batch, one thread"][0](), np.vstack(methods["batch, two threads"][0]())
    np.testing.assert_array_equal(one, two)
    frames = np.random.default_rng(1).normal(0.0, 0.05, (10, 896))
    matches = matching_speed.match_methods(bank, frames)
    quick, plain = (matches[name][0]() for name in ("zero lag, pruned", "zero lag, numpy float32"))
    assert [bank.signals.shape[1] * each.cell[0] + each.cell[1] for each in quick] == plain
    for found in matching_speed.compare_with_reference(bank, [frames[:4], frames[4:]]).values():
        assert found["same"] == found["frames"] == 10
        assert found["largest_score_difference"] < 1e-12


def test_the_caches_are_overwritten_before_each_cold_match(bank, monkeypatch):
    happened: list[str] = []

    class Memory:
        def __iadd__(self, _: float) -> "Memory":
            happened.append("memory")
            return self

    class Matcher:
        def match(self, _: object) -> None:
            happened.append("match")

    for kind in (matching_speed.PrunedMatcher, matching_speed.PrunedZeroLagMatcher):
        monkeypatch.setattr(kind, "from_bank", lambda _: Matcher())
    monkeypatch.setattr(matching_speed.np, "zeros", lambda _: Memory())
    found = matching_speed.cold_seconds(bank, np.ones((3, 896)), turns=2)
    assert [len(each) for each in found.values()] == [2] * 2
    assert happened == ["memory", "match"] * (2 * 2 * 3)
