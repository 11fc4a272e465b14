"""The map of stability on few points: the real controller on the simulated plant."""

import json
import sys
from pathlib import Path

import numpy as np
import pytest

from benchmarks import stability_map


@pytest.mark.parametrize("case", stability_map.CASES, ids=lambda case: case.name)
def test_the_computed_boundary_is_the_simulated_one(case: stability_map.LoopCase) -> None:
    computed = stability_map.computed_boundary(case, 1.1)
    assert np.isfinite(computed)
    assert stability_map.simulated_boundary(case, 1.1, 0) == pytest.approx(computed, rel=0.05)


@pytest.mark.parametrize(("case", "expected"), list(zip(stability_map.CASES, (1.952, 1.760, 1.591), strict=True)))
def test_the_boundary_with_lost_frames_is_that_of_the_monodromy_matrix(
    case: stability_map.LoopCase, expected: float
) -> None:
    """The loop's equations over a cycle of five received and three lost frames have this limit (Floquet)."""
    assert stability_map.simulated_boundary(case, stability_map.EIT_AGE_S, 3) == pytest.approx(expected, rel=0.05)


def test_the_benchmark_writes_the_boundaries(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "argv", ["stability_map", "--out", str(tmp_path / "map.json")])
    monkeypatch.setattr(stability_map, "AGES_S", (0.5,))
    monkeypatch.setattr(stability_map, "LOST", (0, 2))
    stability_map.main()
    found = json.loads((tmp_path / "map.json").read_text())
    assert len(found) == 3
    for rows in found.values():
        assert [(row["age_s"], row["lost"]) for row in rows] == [(0.5, 0), (stability_map.EIT_AGE_S, 2)]
        assert stability_map.worst_disagreement(rows) < 0.05
