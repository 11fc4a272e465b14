"""The map of stability on few points: the real controller on the simulated plant."""

import json
import sys

import numpy as np
import pytest

from benchmarks import stability_map


@pytest.mark.parametrize("case", stability_map.CASES, ids=lambda case: case.name)
@pytest.mark.parametrize(("age_s", "lost"), [(1.1, 0), (stability_map.EIT_AGE_S, 3)])
def test_the_computed_boundary_is_the_simulated_one(case, age_s, lost):
    computed = stability_map.computed_boundary(case, age_s, lost)
    assert np.isfinite(computed)
    assert stability_map.simulated_boundary(case, age_s, lost) == pytest.approx(computed, rel=0.05)


def test_without_losses_the_monodromy_matrix_and_the_roots_agree():
    for case in stability_map.CASES:
        limit = stability_map.computed_boundary(case, 0.9, 0)
        assert stability_map.spectral_radius(case, 0.9, 0, 0.998 * limit) < 1.0
        assert stability_map.spectral_radius(case, 0.9, 0, 1.002 * limit) > 1.0


def test_the_benchmark_writes_the_boundaries(tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["stability_map", "--out", str(tmp_path / "map.json")])
    monkeypatch.setattr(stability_map, "AGES_S", (0.5,))
    monkeypatch.setattr(stability_map, "LOST", (0, 2))
    stability_map.main()
    found = json.loads((tmp_path / "map.json").read_text())
    assert len(found) == 3
    for rows in found.values():
        assert [(row["age_s"], row["lost"]) for row in rows] == [(0.5, 0), (stability_map.EIT_AGE_S, 2)]
        assert stability_map.worst_disagreement(rows) < 0.05
