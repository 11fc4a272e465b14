"""A short form of the soak: some faults in random order."""

import pytest

from benchmarks.soak import soak

pytest.importorskip("rtde_control", reason="ur-rtde has wheels for CPython up to 3.12 on x86-64 only")
pytestmark = pytest.mark.real_time


def test_faults_leave_no_memory_descriptors_or_damaged_recordings():
    found = soak(speed=10, seed=2, goes_on=lambda number: number < 8)
    first, last = found["first_quarter"], found["last_quarter"]
    assert sum(found["faults"].values()) == 8
    assert found["incomplete_recordings"] == []
    assert found["recorded_torques"] > 1000
    assert last["daemon_descriptors"] <= first["daemon_descriptors"] + 2
    assert last["worker_descriptors"] <= first["worker_descriptors"] + 2
    assert last["daemon_mb"] < first["daemon_mb"] + 20
