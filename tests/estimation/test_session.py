"""Sessions on a rig that is played by formulas: another recording, tool or board, and frames that are spoilt."""

import re
from dataclasses import replace

import numpy as np
import pytest

from shearloop.bank.arrays import BoolArray
from shearloop.bank.channels import PAPER_TABLE
from shearloop.bank.errors import CalibrationError
from shearloop.estimation import (
    TRUSTED,
    BeforeFrame,
    Estimate,
    FrameSeries,
    HeldTool,
    KnownTorques,
    Measured,
    Session,
    TactileFrame,
    fit,
    fitting,
)
from shearloop.estimation.fingertip_validator import FingertipValidator, mask_unmeasured
from shearloop.estimation.gain import ToolLaw
from shearloop.estimation.session import FINGERS_MOVED
from shearloop.estimation.twists import find_twists
from tests.estimation.conftest import IDLE_S, follow, judged, kept, twisting


def test_another_recording_is_read_with_honest_intervals(motion_calibration):
    other = twisting(seed=5, peak_nm=0.07)
    _, r, rmse, coverage, _ = judged(follow(motion_calibration, other), other)
    assert r > 0.97
    assert rmse < 0.004
    assert 0.90 < coverage <= 1.0


def test_a_slow_drift_of_the_baseline_changes_little(motion_calibration):
    other = twisting(seed=6)
    drifting = other.channels * (1 + 0.03 * np.linspace(0, 1, len(other.t_s)))[:, None, None]
    shifted = replace(other, channels=drifting)
    found, expected = (judged(follow(motion_calibration, one), one).rmse for one in (shifted, other))
    assert found < 1.5 * expected + 0.001


@pytest.mark.parametrize(
    ("grip", "gain", "shift"), [(0.3, 1.0, 0.0), (2.0, 1.0, 0.0), (1.0, 0.75, 0.0), (1.0, 1.0, 0.03), (0.5, 1.2, 0.03)]
)
def test_another_session_takes_its_own_baseline(motion_calibration, grip, gain, shift):
    """A grip of another strength, a board of another gain, a gel that dried: idle is what the session begins with."""
    other = twisting(seed=20)
    gripped = (other.t_s > 20) & (other.t_s < 140)
    step = np.median(other.channels[gripped], axis=0) - np.median(other.channels[other.t_s < 19], axis=0)
    dried = 1 + shift * np.random.default_rng(20).normal(size=other.channels.shape[1:])
    channels = gain * dried * (other.channels + (grip - 1) * gripped[:, None, None] * step)
    session = replace(other, channels=channels)
    estimates = follow(motion_calibration, session)
    valid = np.array([one.valid for one in estimates])
    assert not valid[(other.t_s < 19) | (other.t_s > 145)].any()
    assert valid[(other.t_s > 32) & (other.t_s < 138)].mean() > 0.9
    _, r, rmse, coverage, _ = judged(estimates, session)
    assert r > 0.95
    assert rmse < 0.008
    assert coverage > 0.85


@pytest.mark.parametrize("tared", [False, True])
def test_three_idle_frames_are_a_baseline_for_an_outright_grip(motion_calibration, tared):
    other = twisting(seed=22)
    first = int(np.flatnonzero(other.t_s > 20)[0]) - 3
    tracker = Session(motion_calibration)
    if tared:
        tracker.tare(3)
    valid = [one.valid for one in follow(tracker, other.between(first, 230))]
    assert not any(valid[:3])
    assert np.mean(valid[25:]) > 0.95


@pytest.mark.parametrize("wanted", [5, 50])
def test_an_idle_frame_of_many_frames_stays_one_of_many(motion_calibration, wanted):
    rng, session = np.random.default_rng(3), Session(motion_calibration, baseline_frames=wanted)
    idle = twisting(seed=5).channels[2]
    frames = [idle + rng.normal(0, 0.002, idle.shape) for _ in range(wanted + 20)]
    session.tare()
    for number, channels in enumerate(frames):
        processed = session.process(TactileFrame.of(0.54 * number, channels))
        if number >= wanted:
            # A mean of 10 has an error that is more than twice as large as a mean of 50.
            averaged = max(wanted, 10)
            expected = channels - np.mean(frames[max(number + 1 - averaged, 0) : number + 1], axis=0)
            np.testing.assert_allclose(processed.difference, expected, rtol=0.02, atol=1e-5)


def test_a_session_that_begins_gripped_is_read_from_its_motion(motion_calibration):
    later = twisting(seed=21).between(60, 240)
    estimates = follow(motion_calibration, later)
    assert np.mean([one.valid for one in estimates[15:]]) > 0.9
    assert judged(estimates, later).r > 0.95


@pytest.mark.parametrize("holds", [False, True])
def test_a_frame_while_the_gripper_holds_something_is_not_idle_though_it_looks_so(
    motion_calibration, holds, monkeypatch
):
    """A daemon that began anew took the held tool for nothing, and named no grip until the next one."""
    monkeypatch.setattr(FingertipValidator, "looks_idle", lambda *_: True)
    later, session = twisting(seed=21).between(60, 240), Session(motion_calibration)
    session.prepare(BeforeFrame(tool=HeldTool(Measured(20.0, 0.5) if holds else None)))
    estimates = follow(session, later)
    if holds:
        assert np.mean([one.valid for one in estimates[15:]]) > 0.9
    else:
        assert estimates[20].reasons == ("no grip at the right and left fingertip",)


def test_no_idle_frame_is_valid(motion_calibration):
    other = twisting(seed=7)
    idle = (other.t_s < 19) | (other.t_s > other.t_s[-1] - 18)
    estimates = follow(motion_calibration, other)
    assert not any(one.valid for one, free in zip(estimates, idle, strict=True) if free)
    assert any(one.valid for one in estimates)
    assert estimates[0].reasons == ("there is no earlier frame to compare with",)
    assert all("no grip" in one.reasons[0] for one in estimates[1:10])


@pytest.mark.parametrize("amplitude_v", [0.02, 0.1, 0.5])
def test_frames_with_a_quarter_of_noise_are_not_valid_and_the_others_are(motion_calibration, amplitude_v):
    rng = np.random.default_rng(8)
    other = twisting(seed=8)
    channels, noisy = other.channels.copy(), np.zeros(len(other.t_s), dtype=bool)
    noisy[60::25] = True
    for i in np.flatnonzero(noisy):
        for layer in channels[i]:
            layer[rng.choice(896, 224, replace=False)] = np.abs(rng.normal(0, amplitude_v, 224))
    spoiled = replace(other, channels=channels)
    estimates = follow(motion_calibration, spoiled)
    assert not any(one.valid for one, spoilt in zip(estimates, noisy, strict=True) if spoilt)
    _, r, rmse, *_ = judged(estimates, spoiled)
    assert r > 0.95
    assert rmse < 0.005


def test_another_fingertip_is_recognised_by_its_pattern_and_refused(motion_calibration):
    for tips in ((2, 1), (1, 3), (4, 5)):
        estimates = follow(motion_calibration, twisting(seed=9, tips=tips))
        assert not any(one.valid for one in estimates)
        assert "another fingertip" in " ".join(estimates[80].reasons)


def test_dead_channels_are_done_without_and_widen_the_interval(motion_calibration):
    other = twisting(seed=10)
    usable = np.random.default_rng(0).random((2, 896)) > 0.2
    damaged = replace(other, channels=np.where(usable, other.channels, 0.0))
    whole, less = follow(motion_calibration, other), follow(motion_calibration, damaged, usable)
    assert judged(less, damaged).rmse < 1.5 * judged(whole, other).rmse
    pairs = [(a, b) for a, b in zip(whole, less, strict=True) if a.valid and b.valid and a.torque_nm == 0.0]
    # Towards the lever's side: the other way each reaches as far as its own frame says.
    widths = [(a.torque_high_nm - a.torque_nm, b.torque_high_nm - b.torque_nm) for a, b in pairs]
    assert widths
    assert all(b > a for a, b in widths)


def test_too_many_dead_channels_give_no_valid_estimate(motion_calibration):
    usable = np.random.default_rng(0).random((2, 896)) > 0.4
    estimates = follow(motion_calibration, twisting(seed=11), usable)
    assert not any(one.valid for one in estimates)
    assert "dead or saturated" in estimates[100].reasons[0]


def test_two_fingertips_have_a_smaller_error_than_one():
    other = twisting(seed=14, noise_v=0.003)
    errors = {}
    for sides in (("right",), ("right", "left")):
        calibration = fit("motion_regression", [twisting(seed=1, noise_v=0.003).select_sides(sides)], "one")
        estimates = follow(calibration, other.select_sides(sides))
        errors[sides] = judged(estimates, other.select_sides(sides)).rmse
    assert errors["right", "left"] < errors["right",]


def test_squeezing_alone_is_no_torque(motion_calibration):
    other = twisting(seed=15)
    gripped = (other.t_s > 25) & (other.t_s < 135)
    idle, reference = other.channels[[5, 50]]
    squeeze = 1 + 0.15 * np.sin(2 * np.pi * other.t_s / 20.0)[:, None, None]
    frames = np.where(gripped[:, None, None], idle + squeeze * (reference - idle), other.channels)
    frames += np.random.default_rng(3).normal(0, 0.001, frames.shape)
    estimates = follow(motion_calibration, replace(other, channels=frames))
    torques = [one.torque_nm for one, held in zip(estimates, gripped, strict=True) if one.valid and held]
    assert len(torques) > 100
    assert np.quantile(np.abs(torques), 0.9) < 0.02


def test_a_frame_of_other_sides_is_refused(motion_calibration):
    with pytest.raises(CalibrationError, match=r"of 2 sides \(right, left\)"):
        Session(motion_calibration).estimate(TactileFrame.of(0.0, np.zeros((1, 896))))


def test_a_session_that_begins_with_a_spoilt_frame_gets_over_it(motion_calibration):
    """What the first frame says is believed only when the next one says the same."""
    other = twisting(seed=16).between(60, 200)
    channels = other.channels.copy()
    channels[0, :, ::4] = 0.01
    estimates = follow(motion_calibration, replace(other, channels=channels))
    assert all(one.valid for one in estimates[20:])


def test_the_tool_of_a_calibration_is_the_one_that_the_gripper_held(recorded, monkeypatch):
    """Two grips of one tool differ by less than the gripper can tell; two tools are not one."""
    monkeypatch.setattr(fitting, "_fit_outputs", lambda blank, *_: blank)

    def named(*held):
        series = [replace(recorded, gripper_mm=tool) for tool in held]
        return fit("motion_regression", series, "rig", timing=TRUSTED).tool_mm

    assert named(Measured(20.4, 1.2), Measured(19.8, 1.1)) == 19.8
    assert named(Measured(20.4, 1.2), None) == 20.4
    assert np.isnan(named(Measured(20.4, 1.2), Measured(10.0, 1.2)))


def test_tools_that_turn_differently_give_no_torque_where_their_diameters_are_only_felt(monkeypatch):
    monkeypatch.setattr(fitting, "_TOOLS_MAY_LEAVE", 0.0)
    short = [replace(twisting(cycles=3, tips=(0,)), gripper_mm=Measured(mm, 1.0)) for mm in (10.0, 20.0)]
    with pytest.raises(CalibrationError, match="the tools of 10 and 20 mm turn so differently"):
        fit("motion_regression", short, "rig", timing=TRUSTED)


TWENTY, FORTY = Measured(20.2, 0.5), Measured(40.3, 0.5)


@pytest.mark.parametrize(
    ("held", "why"),
    [
        (HeldTool(None), ""),
        (HeldTool(None, 20.0), ""),
        (HeldTool(TWENTY, 20.0), ""),
        (HeldTool(None, 40.0), "the tool has 40 mm, and the calibration was made with a tool of 20 mm"),
        (HeldTool(FORTY, 40.0), "the tool has 40 mm, and the calibration was made with a tool of 20 mm"),
        (HeldTool(FORTY, 20.0), "states a tool of 20 mm, and the gripper measures 40.3 mm"),
        (HeldTool(TWENTY, 40.0), "states a tool of 40 mm, and the gripper measures 20.2 mm"),
    ],
)
def test_a_tool_that_is_stated_or_measured_has_a_torque_only_if_it_is_the_calibrated_one(motion_calibration, held, why):
    twisted, session = twisting(seed=5), Session(replace(motion_calibration, tool_mm=20.0))
    session.prepare(BeforeFrame(tool=held))
    found = [session.estimate(frame) for frame in twisted.frames()]
    assert why in session.why_no_torque
    assert any(one.valid for one in found) is not bool(why)
    assert any(why in reason for one in found for reason in one.reasons)
    if why:
        # It is no correction of the gain.
        with pytest.raises(CalibrationError, match=re.escape(why)):
            session.adapt(np.full(len(session.grip_t_s), 0.1))


@pytest.mark.parametrize(
    ("calibrated_mm", "held", "said"),
    [
        (20.0, HeldTool(None), "the tool's diameter is not known, and the torque of right holds for a tool of 20 mm"),
        (20.0, HeldTool(None, 20.0), ""),
        (20.0, HeldTool(TWENTY), ""),
        (np.nan, HeldTool(TWENTY), "the calibration of right names no single tool"),
    ],
)
def test_what_nothing_checks_about_the_tool_is_said(motion_calibration, calibrated_mm, held, said):
    calibration = replace(motion_calibration, tool_mm=calibrated_mm)
    note = calibration.tool_note("right", tool_known=held.diameter is not None)
    assert said in note
    assert bool(note) is bool(said)


def test_another_tool_is_refused_for_as_long_as_it_is_held(motion_calibration):
    twisted = twisting(seed=5)
    calibration = replace(motion_calibration, tool_mm=20.0)
    tracker, plain = Session(calibration), Session(calibration)
    held = {60: Measured(22.9, 0.1), 70: Measured(23.2, 0.1), 80: Measured(23.2, 0.5), 90: Measured(14.0, 1.0)}
    held[100] = None
    refused, same = [], []
    for number, (t_s, channels) in enumerate(zip(twisted.t_s, twisted.channels, strict=True)):
        if number in held:
            tracker.set_tool(held[number])
        frame = TactileFrame.of(float(t_s), channels)
        one, other = tracker.estimate(frame), plain.estimate(frame)
        if any("the tool has" in why for why in one.reasons):
            refused.append(number)
            assert not one.valid
        else:
            same.append(one == other)
    # 15 % of 20 mm are 3 mm, and the half width of what is measured comes on top; where there is no grip that is said.
    assert set(refused) <= {*range(70, 80), *range(90, 100)}
    assert len(refused) > 15
    assert all(same), "earlier tools change nothing that it remembers"
    assert tracker.why_no_torque == ""
    tracker.set_tool(Measured(14.0, 1.0))
    assert tracker.why_no_torque.startswith("the tool has 14 mm")
    unknown = Session(motion_calibration)
    unknown.set_tool(Measured(14.0, 0.1))
    assert any(one.valid for one in follow(unknown, twisted))


LAW = ToolLaw(intercept=0.0, slope=-1.0, spread=0.05, low_mm=10.0, high_mm=40.0)


def adapted_sessions(calibration, *tools):
    """Return sessions that were told 1.2 times the torque on a tool of 20 mm, and then hold another in the same grip.

    With them, the frames of the grip that follow.
    """
    twisted = twisting(seed=5)
    frames = [TactileFrame.of(float(t_s), one) for t_s, one in zip(twisted.t_s, twisted.channels, strict=True)]
    half = len(frames) // 2
    sessions = [Session(replace(calibration, tools=LAW)) for _ in tools]
    for session, tool in zip(sessions, tools, strict=True):
        session.set_tool(Measured(20.0, 0.5))
        for frame in frames[:half]:
            session.estimate(frame)
        session.adapt(1.2 * LAW.gain(20.0) * np.interp(session.grip_t_s, twisted.torque_t_s, twisted.torque_nm))
        session.set_tool(tool)
    return sessions, frames[half:]


def test_another_tool_counts_after_a_corrected_gain_too(motion_calibration):
    """The correction is the fingertip's, the diameter the tool's: neither hides the other."""
    (same, anew, other), frames = adapted_sessions(
        motion_calibration, Measured(20.0, 0.5), Measured(20.4, 0.5), Measured(30.0, 0.5)
    )
    ratios: dict[str, list[float]] = {"anew": [], "other": []}
    widths = []
    for frame in frames:
        one, two, three = (session.estimate(frame) for session in (same, anew, other))
        if one.valid and two.valid and three.valid and one.torque_nm > 1e-3 * LAW.gain(20.0):
            ratios["anew"].append(two.torque_nm / one.torque_nm)
            ratios["other"].append(three.torque_nm / one.torque_nm)
            widths.append((three.torque_high_nm / three.torque_nm, one.torque_high_nm / one.torque_nm))
    assert len(widths) > 5
    assert np.allclose(ratios["anew"], 20.0 / 20.4)
    assert np.allclose(ratios["other"], 20.0 / 30.0)
    assert all(wide > narrow for wide, narrow in widths), "another diameter is less certain"


def test_a_gain_without_a_known_diameter_is_not_corrected(motion_calibration):
    (unknown,), _ = adapted_sessions(motion_calibration, None)
    with pytest.raises(CalibrationError, match="without the tool's diameter"):
        unknown.adapt(np.ones(len(unknown.grip_t_s)))


def test_single_lost_frames_cost_little_and_are_not_invented_in_numbers(motion_calibration):
    whole = twisting(seed=5)
    number = np.arange(len(whole.t_s))
    some = kept(whole, number % 8 != 7)
    found = judged(follow(motion_calibration, some), some)
    assert found.rmse < 1.1 * judged(follow(motion_calibration, whole), whole).rmse
    assert found.coverage > 0.9
    # More than three of the thirteen frames that are remembered would be made up.
    estimates = follow(motion_calibration, kept(whole, number % 3 != 2))
    assert not any(one.valid for one in estimates)
    assert any("are missing" in why for one in estimates for why in one.reasons)


@pytest.mark.parametrize("lost", [(2, {1}), (5, {1, 3}), (7, {1, 3, 5})])
def test_of_a_board_that_leaves_out_half_of_its_frames_no_torque_is_read(motion_calibration, lost):
    whole = twisting(seed=5)
    every, left_out = lost
    part = kept(whole, ~np.isin(np.arange(len(whole.t_s)) % every, list(left_out)))
    period_s = float(whole.t_s[1] - whole.t_s[0])
    estimates = follow(Session(motion_calibration, period_s=period_s), part)
    assert not any(one.valid for one in estimates)
    assert any("are missing" in why for one in estimates for why in one.reasons)


def test_a_board_that_is_faster_than_configured_is_followed_all_the_same(motion_calibration):
    whole = twisting(seed=5)
    fast = replace(whole, t_s=whole.t_s / 5, torque_t_s=whole.torque_t_s / 5)
    configured = follow(Session(motion_calibration, period_s=0.54), fast)
    assert [one.torque_nm for one in configured] == [one.torque_nm for one in follow(motion_calibration, whole)]


@pytest.mark.parametrize("spoilt", [2, 3])
def test_after_frames_left_out_the_interval_holds_a_load_that_rises_meanwhile(motion_calibration, spoilt):
    inside, rng = [], np.random.default_rng(0)
    for seed in range(1, 5):
        series = twisting(seed=seed)
        garbled = (np.arange(len(series.t_s)) + seed) % 17 < spoilt
        noise = 1 + garbled[:, None, None] * rng.normal(0, 0.4, series.channels.shape)
        estimates = follow(motion_calibration, replace(series, channels=series.channels * noise))
        loaded = np.abs(series.torque_at_frames()) > 0.006
        for i in np.flatnonzero(loaded & ~garbled):
            if estimates[i].valid:
                low_nm, high_nm = estimates[i].torque_low_nm, estimates[i].torque_high_nm
                inside.append(low_nm <= series.torque_at_frames()[i] <= high_nm)
    assert len(inside) > 80
    assert np.mean(inside) >= 0.95


@pytest.mark.parametrize("sides", [[0, 1], [1]])
def test_a_frame_that_a_board_sends_again_is_no_new_one(motion_calibration, sides):
    whole = twisting(seed=5)
    frozen, expected = whole.channels.copy(), follow(motion_calibration, whole)
    hung = np.flatnonzero([one.valid for one in expected])[10]
    frozen[hung : hung + 30, sides] = frozen[hung, sides]
    estimates = follow(motion_calibration, replace(whole, channels=frozen))
    assert estimates[hung] == expected[hung]
    said = "a fingertip's frame is the one before: the next came late, or the board sent it again"
    assert all(one.reasons == (said,) for one in estimates[hung + 1 : hung + 30])
    number = np.arange(len(whole.t_s))
    without = kept(whole, (number <= hung) | (number >= hung + 30))
    assert estimates[hung + 30 :] == follow(motion_calibration, without)[hung + 1 :]


@pytest.mark.parametrize("sides", [[0, 1], [1]])
def test_a_fit_refuses_the_repeated_frames_that_the_daemon_refuses(motion_calibration, sides):
    whole = twisting(seed=5)
    frozen = whole.channels.copy()
    frozen[100:110, sides] = frozen[100, sides]
    series = replace(whole, channels=frozen)
    estimates, session = follow(motion_calibration, series), Session(motion_calibration)
    refused = [session.process(frame).reasons for frame in series.frames()]
    assert refused[101:110] == [one.reasons for one in estimates[101:110]]
    assert all("the board sent it again" in reasons[0] for reasons in refused[101:110])


STEP_V = 0.00215


def without_electrodes(series: FrameSeries, electrodes: tuple[int, ...], start: int) -> FrameSeries:
    lost = np.isin(PAPER_TABLE.electrodes, electrodes).any(axis=1)
    channels = series.channels.copy()
    channels[start:, :, lost] = STEP_V
    return replace(series, channels=channels)


@pytest.mark.parametrize("electrodes", [(5,), (5, 19)])
def test_electrodes_that_are_lost_without_a_word_are_done_without(motion_calibration, electrodes):
    whole = twisting(seed=31)
    spoilt = without_electrodes(whole, electrodes, 90)
    found = follow(motion_calibration, spoilt)
    before = follow(motion_calibration, whole)
    assert sum(one.valid for one in found) > 0.9 * sum(one.valid for one in before)
    assert judged(found, spoilt).rmse < 1.5 * judged(before, whole).rmse


def test_many_lost_electrodes_end_it(motion_calibration):
    found = follow(motion_calibration, without_electrodes(twisting(seed=32), (1, 4, 8, 12, 20, 25), 90))
    assert not any(one.valid for one in found[90:])


def test_channels_at_a_rail_are_found_and_done_without(motion_calibration):
    whole = twisting(seed=33)
    rail = np.quantile(whole.channels[5], 0.9)
    clipped = replace(whole, channels=np.minimum(whole.channels, rail))
    found = follow(motion_calibration, clipped)
    assert judged(found, clipped).rmse < 0.02 * 0.06
    # One side is clipped, the other is not.
    frame, usable = np.array([clipped.channels[100, 0], whole.channels[100, 0]]), np.ones((2, 896), dtype=np.bool_)
    left = mask_unmeasured(frame, usable)
    np.testing.assert_array_equal(left[0], frame[0] < rail)
    assert (~left[0]).mean() == pytest.approx(0.1, abs=0.05)
    assert left[1].all()
    # A channel that is dead already hides nothing by what it reads.
    frame[0, 3], usable[0, 3] = 5.0, False
    np.testing.assert_array_equal(mask_unmeasured(frame, usable), left & usable)
    assert not mask_unmeasured(frame, np.zeros_like(usable)).any()


def test_an_ordinary_frame_is_at_no_rail():
    frame = np.floor(twisting(seed=34).channels[50] / STEP_V) * STEP_V
    assert mask_unmeasured(frame, np.ones(frame.shape, dtype=np.bool_)).all()


def test_nine_channels_at_one_value_are_masked_and_eight_are_not():
    frame = np.linspace(0.1, 0.2, 896)[None]
    for count in range(1, 20):
        frame[0, :count] = 0.7
        left = mask_unmeasured(frame, np.ones((1, 896), dtype=np.bool_))
        assert np.count_nonzero(left) == (896 if count < 9 else 896 - count)


def test_a_drift_does_not_lead_a_regression_astray():
    past = twisting(seed=35)
    calibration = fit("regression", [past], "rig")
    later = twisting(seed=36)
    moved = np.random.default_rng(0).normal(0.0, 0.05, 896) * later.channels[5]
    drift = np.linspace(0, 1, len(later.t_s))[:, None, None] * moved
    found = follow(calibration, replace(later, channels=later.channels + drift))
    assert not any(one.valid for one in found[-60:-40])


def test_a_session_settles_with_one_twist_and_adapts_by_the_next(motion_calibration):
    """The first twist after a grip shows another gain, so it decides nothing."""
    whole = twisting(cycles=4, seed=5)
    torque_nm = whole.torque_at_frames()
    first, second, *_ = find_twists(torque_nm)
    torque_nm[first] *= 0.5
    torque_nm[second] *= 1.3
    session, begin, end = Session(motion_calibration), first[-1] + 1, second[-1] + 1

    def torque_of_grip():
        return np.interp(session.grip_t_s, whole.t_s, torque_nm)

    follow(session, whole.between(0, begin))
    with pytest.raises(CalibrationError, match="no second twist of known torque, and the first one settles the gel"):
        session.adapt(torque_of_grip())
    follow(session, whole.between(begin, end))
    # A reference that was silent during a twist shows one twist, too, and it may be the first.
    silent = np.where(session.grip_t_s < whole.t_s[begin], np.nan, torque_of_grip())
    count = int(np.isnan(silent).sum())
    with pytest.raises(CalibrationError, match=rf"\({count} of its {len(silent)} frames have no known torque\)"):
        session.adapt(silent)
    correction = session.adapt(torque_of_grip()).correction
    assert correction.twists == 1
    assert correction.factors.mean() == pytest.approx(1.3, abs=0.1)


def test_a_gain_is_corrected_with_the_tool_that_comes_before_the_frame(motion_calibration):
    whole = twisting(seed=5)
    half = len(whole.t_s) // 2
    sessions = [Session(replace(motion_calibration, tools=LAW)) for _ in range(2)]
    apart, together = sessions
    for session in sessions:
        session.set_tool(Measured(20.0, 0.5))
        follow(session, whole.between(0, half))
    known = KnownTorques("load_cell", 1.2 * np.interp(apart.grip_t_s, whole.torque_t_s, whole.torque_nm))
    tool = Measured(30.0, 0.5)
    apart.set_tool(tool)
    expected = apart.adapt(known.torque_nm)
    together.prepare(BeforeFrame(tool=HeldTool(tool)))
    found = together.adapt(known.torque_nm)
    assert (found.correction.factors == expected.correction.factors).all()
    rest = whole.between(half, len(whole.t_s))
    assert follow(together, rest) == follow(apart, rest)
    assert any(one.valid for one in follow(together, rest))


def test_torques_of_a_grip_that_a_tare_ends_correct_no_gain(motion_calibration):
    session = Session(motion_calibration)
    whole = twisting(seed=5)
    follow(session, whole.between(0, 60))
    known = KnownTorques("load_cell", np.interp(session.grip_t_s, whole.torque_t_s, whole.torque_nm))
    session.prepare(BeforeFrame(begins_tare=True))
    with pytest.raises(CalibrationError, match="known torques do not match the 0 frames of this grip"):
        session.adapt(known.torque_nm)
    assert session.taring, "the tare does not depend on that"
    session.prepare(BeforeFrame(gives_up_tare=True))
    assert not session.taring
    session.prepare(BeforeFrame(begins_tare=True, gives_up_tare=True))
    assert not session.taring, "the idle frame would be of a held tool"


@pytest.fixture
def moving() -> tuple[FrameSeries, BoolArray]:
    """A recording, and the frames of which the fingers moved: those that close, one in between, and those that open."""
    other = twisting(seed=5)
    gripped = np.flatnonzero((other.t_s > IDLE_S) & (other.t_s < other.t_s[-1] - IDLE_S))
    moved = np.zeros(len(other.t_s), dtype=np.bool_)
    moved[[gripped[0] - 1, gripped[0], gripped[40], gripped[-1], gripped[-1] + 1]] = True
    return other, moved


def estimates_of(session: Session, series: FrameSeries, moved: BoolArray) -> list[Estimate]:
    frames = zip(series.t_s.tolist(), series.channels, moved.tolist(), strict=True)
    return [session.estimate(TactileFrame.of(t_s, channels, fingers_moved=one)) for t_s, channels, one in frames]


def test_no_estimate_is_of_a_frame_during_which_the_fingers_moved(motion_calibration, moving):
    series, moved = moving
    session = Session(motion_calibration)
    found = estimates_of(session, series, moved)
    plain = estimates_of(Session(motion_calibration), series, np.zeros_like(moved))
    assert plain[int(np.flatnonzero(moved)[2])].valid
    for one, other, was_moved in zip(found, plain, moved, strict=True):
        if was_moved:
            assert (one.valid, one.torque_nm, one.diameter_mm) == (False, None, None)
            assert one.reasons[0] == FINGERS_MOVED
            assert one.reasons[1:] == other.reasons
        else:
            # The state of the grip goes on, so that one motion costs one frame.
            assert (one.valid, one.torque_nm, one.reasons) == (other.valid, other.torque_nm, other.reasons)


def test_a_correction_of_the_gain_leaves_frames_of_moving_fingers_out(motion_calibration, moving):
    series, moved = moving
    gripped = int(np.flatnonzero(moved)[-2])
    session = Session(motion_calibration)
    estimates_of(session, series.between(0, gripped), moved[:gripped])
    at = float(series.t_s[np.flatnonzero(moved)[2]])
    assert session.grip_t_s.size > 50
    assert at not in session.grip_t_s


def test_an_idle_frame_is_not_taken_while_the_fingers_move(motion_calibration):
    other = twisting(seed=5)
    idle = other.channels[:12].copy()
    # Halfway to a grip, and still below what counts as one.
    idle[5] += 0.1 * (np.median(other.channels[60:80], axis=0) - np.median(other.channels[:20], axis=0))
    session = Session(motion_calibration)
    session.tare(6)
    moved = np.arange(12) == 5
    reasons = [
        session.estimate(TactileFrame.of(t_s, channels, fingers_moved=one)).reasons
        for t_s, channels, one in zip(other.t_s[:12].tolist(), idle, moved.tolist(), strict=True)
    ]
    assert reasons[4:7] == [("taking the idle frame, 5 of 6",), (FINGERS_MOVED,), ("taking the idle frame, 1 of 6",)], (
        "something may have been gripped or released"
    )
    assert session.taring is False


@pytest.mark.parametrize("moved", [False, True])
def test_the_idle_frame_does_not_follow_moving_fingers(motion_calibration, moved):
    other = twisting(seed=5)
    step = np.median(other.channels[60:80], axis=0) - np.median(other.channels[:20], axis=0)
    flags = np.arange(22) == 15
    found = []
    for touched in (0.0, 0.02):
        # Too little for a grip: such a frame would count as idle.
        channels = other.channels[:22] + touched * step * flags[:, None, None]
        session = Session(motion_calibration)
        estimates_of(session, replace(other.between(0, 22), channels=channels), flags & moved)
        found.append(session.process(TactileFrame.of(float(other.t_s[22]), other.channels[22])).difference)
    assert np.array_equal(*found) == moved
    assert found[0].any()
