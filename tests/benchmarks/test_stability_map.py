"""The map of stability on few points: the real controller on the simulated plant."""

import json
import sys

from benchmarks import stability_map


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
        assert rows[1]["computed"] is None
        assert rows[1]["simulated"] < 4.0
