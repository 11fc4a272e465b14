"""What a session keeps of its frames, where what it keeps would say something of another time."""

import re

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from shearloop.estimation import Session
from shearloop.estimation.values import GripState, TactileFrame

UP, DOWN = np.linspace(0, 1, 21), np.linspace(1, 0, 21)[1:]


@pytest.fixture
def like(motion_calibration):
    """Return what makes a frame at a time, so far from idle to gripped; no two are the same to the last digit."""
    idle, gripped = (
        np.array([getattr(guard, name) for guard in motion_calibration.validators]) for name in ("idle", "gripped")
    )
    return lambda t_s, share: TactileFrame.of(t_s, 1.1 * (idle + share * (gripped - idle)) + 1e-13 * t_s)


@pytest.fixture
def process(like):
    """Return what plays shares of a grip to a session, every half second from a time on, and returns what it says."""

    def play(session, shares, start_s=0.0, step_s=0.5):
        return [session.process(like(start_s + step_s * i, share)) for i, share in enumerate(shares)]

    return play


@pytest.fixture
def taring(motion_calibration):
    """Return what begins a session with so many frames for its zero."""

    def begin(n):
        session = Session(motion_calibration)
        session.tare(n)
        return session

    return begin


def test_a_frame_from_before_a_zero_is_not_one_of_the_last_frames(motion_calibration, like):
    """A zero that is asked for while a tool is held, which is let go and gripped again before it is complete."""
    tracker, reasons = Session(motion_calibration), []
    n_lags = motion_calibration.estimator.motion.n_needed - 1
    before = [*np.zeros(12), *UP, *np.ones(n_lags)]
    for i, share in enumerate([*before, *DOWN, *UP, *np.ones(n_lags + 1)]):
        if i == len(before):
            tracker.tare(len(DOWN) + len(UP))
        reasons.append(tracker.estimate(like(0.5 * i, share)).reasons)
    assert not reasons[len(before) - 1]
    after = reasons[-n_lags - 1 :]
    waits = [f"gripped too recently: {n} more frames are needed" for n in range(n_lags, 1, -1)]
    assert after[:-1] == [(wait,) for wait in (*waits, "gripped too recently: 1 more frame is needed")]
    assert not after[-1]


def test_a_grip_a_third_as_strong_as_the_one_before_the_zero_is_one(motion_calibration, process):
    """What a grip was before a zero says nothing of the next one, which comes before an idle frame was seen again."""
    tracker = Session(motion_calibration)
    n_lags = motion_calibration.estimator.motion.n_needed - 1
    process(tracker, [*np.zeros(12), *UP, *np.ones(n_lags + 1)])
    tracker.tare(10)
    assert not process(tracker, [*np.zeros(10), *np.full(n_lags + 6, 0.3)], start_s=100.0)[-1].reasons


def test_a_zero_during_which_a_tool_is_let_go_begins_anew(taring, process, like):
    memory = taring(8)
    reasons = [one.reasons for one in process(memory, [1, 1, 1, 1, 1, *np.zeros(9)])]
    assert [why[0] for why in reasons[2:5]] == [f"taking the idle frame, {n} of 8" for n in (3, 4, 5)]
    assert all("jumped" in why[0] for why in reasons[5:7])
    assert reasons[7] == ("taking the idle frame, 1 of 8",)
    assert memory.taring
    memory.process(like(7.0, 0.0))
    assert not memory.taring
    assert np.abs(memory.process(like(7.5, 0.0)).difference).max() < 1e-12


@pytest.mark.parametrize(("first", "then"), [(1.0, 0.0), (0.0, 1.0)])
@pytest.mark.parametrize("step_s", [1.5, 20.0, -5.0])
def test_a_zero_in_whose_gap_a_tool_is_let_go_or_gripped_begins_anew(taring, process, first, then, step_s):
    memory = taring(8)
    process(memory, [first] * 5)
    reasons = [one.reasons for one in process(memory, [then] * 9, start_s=2.0 + step_s)]
    assert all("jumped" in why[0] for why in reasons[:2])
    assert [why[0] for why in reasons[2:]] == [f"taking the idle frame, {n} of 8" for n in range(1, 8)]
    assert memory.taring


def test_a_zero_with_a_gap_in_which_nothing_happens_goes_on(taring, process):
    memory = taring(8)
    process(memory, [0.0] * 5)
    process(memory, [0.0] * 3, start_s=22.5)
    assert not memory.taring


def test_a_zero_that_is_given_up_gives_no_estimate_until_the_next(taring, process, like):
    session = taring(8)
    process(session, [0.0] * 5)
    session.give_up_tare()
    assert not session.taring
    for number in range(12):
        estimate = session.estimate(like(2.5 + 0.5 * number, 1.0))
        assert not estimate.valid
        assert estimate.reasons == (
            "no idle frame: it took too long, or something was gripped; tare again with nothing gripped",
        )
    session.tare(2)
    assert session.taring
    assert session.estimate(like(9.0, 0.0)).reasons == ("taking the idle frame, 1 of 2",)


def test_a_zero_of_two_frames_is_a_baseline_for_a_weak_grip(motion_calibration, taring, process):
    seen = process(taring(2), [0, 0, *np.full(motion_calibration.estimator.motion.n_needed + 5, 0.3)])
    assert not seen[-1].reasons
    steps = np.array([guard.gripped - guard.idle for guard in motion_calibration.validators])
    assert seen[-1].difference == pytest.approx(0.3 * steps)


@pytest.mark.parametrize("kind", ["garbled", "saturated"])
@pytest.mark.parametrize("spoilt", [1, 3, 4])
def test_up_to_three_spoilt_frames_are_left_out_and_more_end_the_memory(
    motion_calibration, process, like, spoilt, kind
):
    tracker, rng = Session(motion_calibration), np.random.default_rng(4)
    n_lags = motion_calibration.estimator.motion.n_needed - 1
    shares = [*np.zeros(12), *UP, *np.ones(n_lags + 2)]
    assert not process(tracker, shares)[-1].reasons
    for i in range(len(shares), len(shares) + spoilt):
        frame = like(0.5 * i, 1.0)
        if kind == "garbled":
            frame = TactileFrame.of(frame.t_s, frame.channels * (1 + rng.normal(0, 0.3, frame.channels.shape)))
        else:
            frame = TactileFrame.of(frame.t_s, frame.channels, rng.random(frame.channels.shape) > 0.4)
        assert "fingertip" in tracker.estimate(frame).reasons[0]
    after = tracker.estimate(like(0.5 * (len(shares) + spoilt), 1.0))
    many = f"too many frames in a row were disturbed or are missing: {n_lags} more frames are needed"
    assert after.reasons == (() if spoilt <= 3 else (many,))


@pytest.mark.parametrize("lost", [2, 3, 4])
def test_of_a_quick_board_two_lost_frames_are_too_many_as_of_a_slow_one(motion_calibration, process, lost):
    """A frame is put halfway where one is missing: with more of them lost, all before would be of another time."""
    tracker = Session(motion_calibration, period_s=0.27)
    n_lags = motion_calibration.estimator.motion.n_needed - 1
    shares = [*np.zeros(12), *UP, *np.ones(n_lags + 2)]
    assert not process(tracker, shares, step_s=0.27)[-1].reasons
    after = [one.reasons for one in process(tracker, [1.0, 1.0], 0.27 * (len(shares) + lost), 0.27)]
    for (reason,), wanted in zip(after, (n_lags + 1, n_lags), strict=True):
        gap = r"no frame came for (\S+) s where one comes every 0\.27 s .* is not known: (\d+) more frames are needed"
        found = re.fullmatch(gap, reason)
        assert float(found[1]) == pytest.approx(0.27 * (lost + 1), abs=0.051)
        assert int(found[2]) == wanted


def test_a_new_grip_after_a_gap_waits_for_the_grip_alone(motion_calibration, process):
    tracker = Session(motion_calibration)
    process(tracker, [*np.zeros(12), *UP])
    process(tracker, [0.0, 0.0], 60.0)
    reasons = " ".join(why for one in process(tracker, UP, 61.0) for why in one.reasons)
    assert "gripped too recently: " in reasons
    assert "no frame came" not in reasons


def test_a_board_that_turns_out_slower_than_its_first_frames_is_followed(motion_calibration, like):
    tracker = Session(motion_calibration)
    times = [*0.1 * np.arange(12), *(2.0 + 0.5 * np.arange(60))]
    shares = [*np.zeros(20), *UP, *np.ones(31)]
    reasons = [tracker.estimate(like(t_s, share)).reasons for t_s, share in zip(times, shares, strict=True)]
    assert not reasons[-1]


STEPS_S = {"garbled": 0.5, "saturated": 0.5, "lost": 1.0, "late": 1.2, "gap": 1.3, "back": -2.0}


@st.composite
def sessions(draw):
    """Return how each frame comes, and whether a tool is gripped, or let go, just before it."""
    frames = []
    for _ in range(draw(st.integers(3, 8))):
        some = draw(st.lists(st.sampled_from(sorted(STEPS_S)), max_size=4))
        frames += [(kind, draw(st.booleans())) for kind in some] + [("good", draw(st.booleans()))]
        frames += [("good", False)] * draw(st.sampled_from((0, 1, 2, 20)))
    return frames


@pytest.mark.long
def test_what_is_valid_is_of_one_grip_and_hardly_made_up(motion_calibration):
    """Against a plain account of what happened: whatever frames are lost or spoilt, and whatever happens meanwhile."""
    guards, motion = motion_calibration.validators, motion_calibration.estimator.motion
    idle, gripped = (np.array([getattr(guard, name) for guard in guards]) for name in ("idle", "gripped"))
    begun = [*[("good", False)] * 12, ("good", True), *[("good", False)] * 20]

    @given(sessions(), st.sampled_from((0.5, np.inf)))
    @settings(max_examples=100, deadline=None)
    @example(session=[*[("gap", False)] * 4, ("good", False), ("late", False), ("gap", False), *[("good", True)] * 6,
                      *[("good", False)] * 20], period_s=np.inf)  # fmt: skip
    def holds(session, period_s):
        memory, rng = Session(motion_calibration, period_s=period_s), np.random.default_rng(0)
        t_s, held, before, other, account, steps_s = 0.0, False, None, None, [], []
        for kind, changes in [*begun, *session]:
            step_s = STEPS_S.get(kind, 0.5)
            t_s, held = t_s + step_s, held ^ changes
            steps_s = [*steps_s, step_s][-9:] if step_s > 0 else steps_s
            if period_s == np.inf and np.median(steps_s) > 0.5:
                # Of a board that leaves out half of its frames the period cannot be learned, nor then what is missing.
                return
            channels = idle + held * (gripped - idle)
            usable = rng.random(channels.shape) > 0.4 if kind == "saturated" else None
            if kind == "garbled":
                channels = channels * (1 + rng.normal(0, 0.4, channels.shape))
            moment = memory.process(TactileFrame.of(t_s, channels, usable))
            spoilt = kind in ("garbled", "saturated")
            # A single frame like another is left out; of two, all before is of another time.
            changed = not spoilt and before not in (None, held)
            if kind in ("gap", "back") or (changed and other):
                account.clear()
                changed, before = False, None
            if kind in ("lost", "late"):
                account.append(None)
            account.append(None if spoilt or changed else held)
            before, other = before if spoilt or changed else held, changed
            if not moment.reasons:
                last = account[-motion.n_needed :]
                assert not spoilt
                assert len(last) == motion.n_needed
                assert last.count(None) <= max(3, motion.n_lags // 4)
                assert set(last) <= {True, None}
                for found in (moment.difference, moment.mean_difference):
                    np.testing.assert_allclose(found, gripped - idle, atol=1e-9)

    holds()


def test_motion_is_read_without_the_gain_of_the_idle_frame(motion_calibration):
    """After a release the gel's idle voltages stay low for a minute; the next grip moves it in volts as before.

    A board's gain would scale the motion too, and the estimate with it: the spread of gains between grips covers that.
    """
    guards, motion = motion_calibration.validators, motion_calibration.estimator.motion
    idle, gripped = (np.array([getattr(guard, name) for guard in guards]) for name in ("idle", "gripped"))
    # The gel still creeps, so that there is motion to read.
    held = [gripped + 0.05 * (gripped - idle) * np.sin(0.3 * i) for i in range(2 * motion.n_lags)]

    def features(idle_share, held_share=1.0):
        session = Session(motion_calibration)
        frames = [*[idle_share * idle] * 12, *(held_share * one for one in held)]
        return [session.process(TactileFrame.of(0.5 * i, one + 1e-13 * i)) for i, one in enumerate(frames)][-1]

    remembered, fresh, scaled = features(0.95), features(1.0), features(1.1, 1.1)
    assert not remembered.reasons
    assert not fresh.reasons
    assert np.abs(fresh.motion).max() > 0
    np.testing.assert_allclose(remembered.motion, fresh.motion, rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(scaled.motion, 1.1 * fresh.motion, rtol=1e-6, atol=1e-9)


def test_a_frame_shows_a_grip_none_or_nothing(motion_calibration, process):
    session = Session(motion_calibration)
    first, *idle = process(session, np.zeros(12))
    *rising, held = process(session, [*UP, *np.ones(12)], 6.0)
    assert first.grip is GripState.UNKNOWN, "it is refused: there is none to compare with"
    assert {one.grip for one in idle} == {GripState.NONE}
    assert (held.grip, held.reasons) == (GripState.HELD, ())
    too_recent = [one for one in rising if one.grip is GripState.HELD and one.reasons]
    assert len(too_recent) == motion_calibration.estimator.motion.n_needed - 1
