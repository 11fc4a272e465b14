"""A short form of the soak: some faults in random order."""

import pytest

from benchmarks.soak import soak
from shearloop.drivers.defaults import LOAD_CELL_RATE_HZ

pytest.importorskip("rtde_control", reason="ur-rtde has wheels for CPython up to 3.12 on x86-64 only")
pytestmark = pytest.mark.real_time


def test_faults_leave_no_memory_descriptors_or_damaged_recordings():
    speed, faults = 10, 8
    found = soak(speed, seed=2, goes_on=lambda number: number < faults)
    first, last = found["first_quarter"], found["last_quarter"]
    assert sum(found["faults"].values()) == faults
    assert found["incomplete_recordings"] == []
    # An experiment takes half a second at least until its fault.
    assert found["recorded_torques"] > faults * 0.5 * speed * LOAD_CELL_RATE_HZ
    assert last["daemon_descriptors"] <= first["daemon_descriptors"] + 2
    assert last["worker_descriptors"] <= first["worker_descriptors"] + 2
    assert last["daemon_mb"] < first["daemon_mb"] + 20
