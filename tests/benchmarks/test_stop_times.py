"""The benchmark of stops, with one cause."""

import json
import sys

import pytest

from benchmarks import stop_times

pytest.importorskip("rtde_control", reason="ur-rtde has wheels for CPython up to 3.12 on x86-64 only")
pytestmark = pytest.mark.real_time


def test_the_benchmark_measures_a_stop_and_draws_it(tmp_path, monkeypatch, capsys):
    arguments = ["--out", str(tmp_path), "--repeats", "1", "--only", "straight: pipe to the worker"]
    monkeypatch.setattr(sys, "argv", ["stop_times", *arguments])
    stop_times.main()
    found = json.loads((tmp_path / "stop-times.json").read_text())
    (cause,) = found["causes"].values()
    assert cause["promise_s"] == 0.2
    # The command holds for 0.1 s, and the test's computer may be busy.
    assert [0.05 < time_s < 1.0 for time_s in cause["times_s"]] == [True]
    assert (tmp_path / "stop-times.svg").stat().st_size > 1000
    assert "| straight: pipe to the worker dead | 0.2 |" in capsys.readouterr().out
