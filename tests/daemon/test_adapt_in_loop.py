"""A wrong gain is corrected by a twist of known torque, in the whole loop over real ports."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml

from shearloop.studies.emulated_calibration import calibrate, record
from tests.cli.emulate_rig.rig import write_rig_bank
from tests.fixtures.rigs import SPEED, Watcher, experiment, running_rig, started
from tests.tools.recordings.test_replay import replayed

pytestmark = pytest.mark.real_time


def write_calibration(bank: Path, path: Path, gain: float) -> None:
    """Calibrate the right fingertip on torques that are too large by a factor."""
    (series,) = record(bank, 3, (20.0,))
    calibrate([replace(series, torque_nm=gain * series.torque_nm)], ("right",)).save(path)


def loaded_errors(watcher: Watcher, frames: range) -> tuple[float, float]:
    """Return the root mean square of the loaded frames' errors against the load cell, and of their torques."""
    loads = watcher.seen["load.torque"]
    found = [one for one in watcher.seen["eit.estimate"] if one["valid"] and one["frame"] in frames]
    t_ns, torque_nm = [one["t_mono_ns"] for one in loads], [one["torque_nm"] for one in loads]
    truth = np.interp([one["t_mono_ns"] for one in found], t_ns, torque_nm)
    errors = (np.array([one["torque_nm"] for one in found]) - truth)[truth > 0.05]
    assert len(errors) > 5
    return float(np.sqrt(np.mean(errors**2))), float(np.sqrt(np.mean(truth[truth > 0.05] ** 2)))


async def test_adapt_corrects_a_wrong_gain_until_the_next_grip_and_is_replayed(rig_config, tmp_path):
    bank, calibration = write_rig_bank(tmp_path / "rig.bank", 3.0), tmp_path / "wrong.cal"
    write_calibration(bank, calibration, 1.4)
    content = yaml.safe_load(rig_config.read_text())
    content["fingertips"]["right"] |= {"bank": None, "calibration": str(calibration)}
    # A busy computer may be late, and a fingertip that has lost frames needs thirteen again.
    speed = SPEED // 2
    content["loop"]["stale_after_s"] = 0.5
    content["fingertips"]["right"]["frame_period_s"] *= SPEED / speed
    content["load_cell"]["rate_hz"] *= speed / SPEED
    rig_config.write_text(yaml.safe_dump({**content, "recording": {"folder": "recordings"}}))
    twist = {"do": "twist", "angles_rad": [0.2], "speed_rad_per_s": 0.5, "hold_s": 1.0}
    grip = {"do": "grip", "width_mm": 5, "force_n": 60}
    adapt = {"do": "adapt", "fingertip": "right"}
    steps = [twist, twist, adapt, twist, adapt | {"reference": "wrench"}, {"do": "release"}, grip, twist]
    async with running_rig(rig_config, bank, speed) as (_, watcher, _fault, command):
        await started(watcher, command, experiment(tmp_path, *steps))
        state = await watcher.until("loop.state", lambda state: state["phase"] in ("done", "stopped"))
    assert state["phase"] == "done", state["activity"]
    adapted, again = watcher.seen["eit.adapted"]
    assert (adapted["reference"], again["reference"]) == ("load_cell", "wrench")
    estimates, first = watcher.seen["eit.estimate"], adapted["frame"]
    released = min(one["frame"] for one in estimates if one["frame"] > first and "no grip" in one["reason"])
    before, load = loaded_errors(watcher, range(first))
    after, _ = loaded_errors(watcher, range(first, released))
    later, _ = loaded_errors(watcher, range(released, estimates[-1]["frame"] + 1))
    # This grip responds 6 % more strongly than those of the calibration; a busy computer adds noise to a few frames.
    assert (adapted["gain_before"], before / load) == (pytest.approx(1.49, abs=0.15), pytest.approx(0.48, abs=0.15))
    assert adapted["gain_after"] == pytest.approx(1.0, abs=0.05)
    assert (again["gain_before"], again["gain_after"]) == (pytest.approx(1.0, abs=0.1), pytest.approx(1.0, abs=0.05))
    assert adapted["spread_after"] < adapted["spread_before"]
    assert after < 0.3 * before
    assert later == pytest.approx(before, rel=0.3), "another grip has another gain"
    (recording,) = (tmp_path / "recordings").glob("*_test.mcap")
    _, comparison = await replayed(recording, math.inf)
    assert comparison.different == {}, comparison.examples
    assert comparison.compared["eit.adapted"] == 2
