"""Which states say something new."""

import dataclasses
import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from shearloop.drivers.ur.messages import RobotState
from shearloop.drivers.ur.news import ANGLE_NEWS_RAD, News
from tests.drivers.ur.flight import Flight

STATE = Flight().state
# What is measured, or only numbers the cycle; what was commanded is answered by replies.
MEASURED = {
    "timestamp_s", "q_rad", "qd_rad_per_s", "tcp_pose", "wrench", "speed_scaling", "t_mono_ns", "age_ns",
    "wrist_torque_nm", "cycle", "sent", "motion_id",
}  # fmt: skip
# Of these follow others, which tell; and a reading that is not connected ends the process.
TOLD_BY_OTHERS = {"protective_stop", "emergency_stop", "connected"}
OTHER = {"blocked": "Not enabled.", "motion": "stopping", "ended": "arrived", "clipped": ("too fast",)}


def told(state: RobotState) -> News:
    news = News()
    news.tell(state)
    return news


def at(wrist_rad: float) -> RobotState:
    return dataclasses.replace(STATE, q_rad=(*STATE.q_rad[:5], wrist_rad))


def test_first_state_is_new_and_the_same_again_is_not() -> None:
    assert News().brings(STATE)
    assert not told(STATE).brings(STATE)


@pytest.mark.parametrize(
    "name", sorted({field.name for field in dataclasses.fields(STATE)} - MEASURED - TOLD_BY_OTHERS)
)
def test_whatever_happens_is_new(name: str) -> None:
    before = getattr(STATE, name)
    after = OTHER.get(name, not before if isinstance(before, bool) else before + 1 if isinstance(before, int) else "")
    assert after != before
    assert told(STATE).brings(dataclasses.replace(STATE, **{name: after}))


def test_what_is_measured_is_not_new_but_the_wrists_angle() -> None:
    measured = dataclasses.replace(
        STATE, timestamp_s=9.0, qd_rad_per_s=(1.0,) * 6, tcp_pose=(1.0,) * 6, wrench=(5.0,) * 6, speed_scaling=0.5,
        t_mono_ns=9, age_ns=9, wrist_torque_nm=1.0, cycle=99, sent=None, motion_id=7,
    )  # fmt: skip
    assert not told(STATE).brings(measured)


@given(st.lists(st.floats(-0.004, 0.004), max_size=30))
def test_angle_that_is_known_is_never_further_off_than_news_would_be(steps: list[float]) -> None:
    news, known_rad, wrist_rad = told(at(0.0)), 0.0, 0.0
    for step in steps:
        wrist_rad += step
        if news.brings(at(wrist_rad)):
            news.tell(at(wrist_rad))
            known_rad = wrist_rad
        assert abs(wrist_rad - known_rad) <= ANGLE_NEWS_RAD


def test_angle_that_is_no_number_is_new() -> None:
    assert told(STATE).brings(at(math.nan))
    assert told(at(math.nan)).brings(STATE)
    assert told(at(math.nan)).brings(at(math.nan))
