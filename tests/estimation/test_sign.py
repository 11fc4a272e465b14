"""A load cell that is mounted the other way reads each torque with the other sign, and nothing else changes."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from shearloop.bank.errors import CalibrationError
from shearloop.estimation import TRUSTED, Calibration, Estimate, FrameSeries, Measured, Session, adapt, fit
from tests.estimation.conftest import elastic, follow, twisting

TOOLS_MM = (10.0, 20.0, 40.0)


def negated(series: FrameSeries) -> FrameSeries:
    return replace(series, torque_nm=-series.torque_nm)


def of_tool(series: FrameSeries, tool_mm: float) -> FrameSeries:
    return replace(series, diameter_mm=np.full(len(series.t_s), tool_mm))


def of_three_tools() -> list[FrameSeries]:
    """Return one grip of each tool: on a thinner tool the same motion is a larger torque."""
    series = (twisting(cycles=3, tips=(1,), seed=seed) for seed in range(3))
    return [
        of_tool(replace(one, torque_nm=one.torque_nm * (20.0 / tool_mm) ** 2), tool_mm)
        for one, tool_mm in zip(series, TOOLS_MM, strict=True)
    ]


def check_mirrored(estimates: Sequence[Estimate], mirrored: Sequence[Estimate]) -> None:
    """Check that the torques have the other sign, and all else is the same."""
    for one, other in zip(estimates, mirrored, strict=True):
        assert other.valid == one.valid
        if one.torque_nm is not None:
            assert other.torque_nm == -one.torque_nm
            assert (other.torque_low_nm, other.torque_high_nm) == (-one.torque_high_nm, -one.torque_low_nm)
        assert (other.diameter_mm, other.diameter_low_mm) == (one.diameter_mm, one.diameter_low_mm)
    assert sum(one.torque_nm is not None and abs(one.torque_nm) > 0.01 for one in estimates) > 10


@pytest.mark.long
@pytest.mark.parametrize("estimator", ["motion_regression", "regression"])
@pytest.mark.parametrize("timing", [None, TRUSTED])
def test_negated_torques_give_negated_estimates(recorded, estimator, timing):
    later = twisting(seed=5)
    fitted, mirrored = (fit(estimator, [one], "rig", timing=timing) for one in (recorded, negated(recorded)))
    assert mirrored.only_sign == -fitted.only_sign
    check_mirrored(follow(fitted, later), follow(mirrored, later))


def test_twists_both_ways_have_no_preferred_sign():
    both_ways, later = elastic(4, 4), elastic(4, seed=1)
    fitted, mirrored = (
        fit("motion_regression", [one], "rig", timing=TRUSTED) for one in (both_ways, negated(both_ways))
    )
    check_mirrored(follow(fitted, later), follow(mirrored, later))


def held(calibration: Calibration, tool_mm: float) -> Session:
    session = Session(calibration)
    session.set_tool(Measured(tool_mm, 0.1))
    return session


@pytest.mark.long
def test_a_load_cell_that_reads_negative_calibrates_several_tools():
    recordings = of_three_tools()
    fitted = fit("motion_regression", recordings, "rig", timing=TRUSTED)
    mirrored = fit("motion_regression", [negated(one) for one in recordings], "rig", timing=TRUSTED)
    assert fitted.tools is not None
    assert mirrored.tools == fitted.tools
    for tool_mm in (10.0, 30.0):
        later = twisting(tips=(1,), seed=9)
        check_mirrored(follow(held(fitted, tool_mm), later), follow(held(mirrored, tool_mm), later))


def test_tools_that_are_twisted_in_different_directions_are_told_so():
    first, second, third = of_three_tools()
    with pytest.raises(CalibrationError, match="or with twists of every tool in one direction"):
        fit("motion_regression", [first, negated(second), third], "rig", timing=TRUSTED)


def test_a_correction_of_the_gain_has_the_load_cells_sign(motion_calibration, recorded):
    mirrored = fit("motion_regression", [negated(recorded)], "rig")
    known, later = twisting(cycles=3, seed=7), twisting(seed=8)
    known = replace(known, torque_nm=1.4 * known.torque_nm)
    adapted, correction = adapt(motion_calibration, [known], "twists")
    adapted_mirrored, mirrored_correction = adapt(mirrored, [negated(known)], "twists")
    np.testing.assert_array_equal(mirrored_correction.factors, correction.factors)
    check_mirrored(follow(adapted, later), follow(adapted_mirrored, later))
