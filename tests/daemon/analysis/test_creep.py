import numpy as np
import pytest

from shearloop.daemon.analysis.creep import Stretch, fit_creep
from shearloop.daemon.control.loop_inputs import Creep
from shearloop.daemon.errors import UserError
from shearloop.drivers.emulators.scene import Twin, TwinSettings

PERIOD_S = 0.5412


def twisted(for_s: float, noise_nm: float = 0.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Times, shears and torques of the rig's gel, twisted for 40 s of each minute."""
    twin = Twin(TwinSettings(hysteresis_rad=0.0))
    times = np.arange(0.0, for_s, PERIOD_S)
    states = [twin.step(PERIOD_S, 0.15 if t_s % 60 < 40 else 0.0, 60.0) for t_s in times]
    noise = np.random.default_rng(0).normal(0.0, noise_nm, times.size)
    shears = np.array([state.shear_torque_nm for state in states]) + noise
    return times, shears, np.array([state.torque_nm for state in states])


def test_without_noise_the_torque_of_the_rigs_gel_comes_back_from_its_shear():
    times, shears, torques = twisted(120.0)
    creep = Creep(0.08, 20.0)
    found = [creep.torque_nm(shear, round(t_s * 1e9)) for t_s, shear in zip(times, shears, strict=True)]
    assert np.abs(shears - torques).max() > 0.006
    np.testing.assert_allclose(found, torques, atol=4e-4)


def test_noise_shifts_neither_the_time_nor_the_scale_but_widens_what_is_found():
    """Fitted the other way round, torque to readings, 12 mN·m of noise make 20 s 50 s and the scale 0.95."""
    times, shears, torques = twisted(600.0)
    random = np.random.default_rng(5)
    found = [fit_creep([Stretch(times, shears + random.normal(0, 0.012, times.size), torques)]) for _ in range(8)]
    assert np.median([one.creep.time_s for one in found]) == pytest.approx(20.0, rel=0.3)
    assert np.mean([one.creep.share for one in found]) == pytest.approx(0.08, abs=0.02)
    assert np.mean([one.scale for one in found]) == pytest.approx(1.0, abs=0.015)


def test_a_wrong_scale_of_the_estimator_is_not_taken_for_creep():
    times, shears, torques = twisted(600.0)
    found = fit_creep([Stretch(times, 1.1 * shears, torques)])
    assert found.creep.share == pytest.approx(0.08, abs=0.005)
    assert found.creep.time_s == pytest.approx(20.0, rel=0.1)
    assert (found.scale, found.offset_nm) == (pytest.approx(1 / 1.1, rel=0.01), pytest.approx(0.0, abs=1e-4))
    fooled = fit_creep([Stretch(times, 1.1 * shears, torques)], scale_is_right=True)
    assert fooled.creep.time_s < 5.0


@pytest.mark.parametrize(("fingertip_nm", "load_cell_nm"), [(0.02, 0.0), (0.0, 0.005)])
def test_several_grips_tell_as_much_as_one_long_one_and_a_wrong_zero_tells_hardly_anything(fingertip_nm, load_cell_nm):
    """The load cell's zero was taken when the recording began; a fingertip's may be far off."""
    times, shears, torques = twisted(300.0)
    found = fit_creep([Stretch(t_s, shears + fingertip_nm, torques + load_cell_nm) for t_s in (times, times + 1e4)])
    # What a gel would have crept under the zero's own torque is in it.
    assert found.offset_nm == pytest.approx(load_cell_nm - fingertip_nm, rel=0.08)
    assert found.creep.share == pytest.approx(0.08, abs=0.005)
    assert found.creep.time_s == pytest.approx(20.0, rel=0.1)


def test_a_new_grip_finds_the_gel_at_rest():
    creep = Creep(0.1, 5.0)
    for second in range(60):
        creep.torque_nm(0.1, second * 10**9)
    assert creep.torque_nm(0.0, 60 * 10**9) < -0.008
    creep.reset()
    assert creep.torque_nm(0.05, 61 * 10**9) == 0.05


def test_what_is_no_creep_is_refused():
    times, shears, torques = twisted(120.0)
    with pytest.raises(UserError, match="too few"):
        fit_creep([Stretch(times[:10], shears[:10], torques[:10])])
    with pytest.raises(UserError, match="does not fall behind"):
        fit_creep([Stretch(times, torques, shears)])
    with pytest.raises(UserError, match="at the end of the recording"):
        fit_creep([Stretch(times, shears, shears - 0.01 * np.cumsum(shears) / shears.size)])
