from dataclasses import replace
from typing import Any

import pytest

from shearloop.daemon.control.experiment_schema import ExperimentLimits
from shearloop.daemon.control.fault_detection import (
    ARM_STALE_S,
    LONGEST_HANG_S,
    Grasp,
    RunningStep,
    Watched,
    compared_for_s,
    detect_faults,
)
from shearloop.daemon.control.faults import TABLE, Fault, FaultCode, Response
from shearloop.daemon.control.inputs import ArmStatus, GripperStatus, LatestInputs
from shearloop.daemon.control.wrench import publish_every, wrench_source
from shearloop.daemon.loop_config import LoopConfig
from shearloop.daemon.torques import TorqueSample, TorqueSource
from shearloop.drivers.ur.sample_age import SampleAge

EIT = TorqueSource(name="right", period_s=0.5412, window_s=0.5412)
LOAD = TorqueSource(name="load_cell", period_s=1 / 10.9)
WRENCH = TorqueSource(name="wrench", period_s=0.04, from_robot=True)
NOW_NS = 100_000_000_000
FRESH_ARM = ArmStatus(0.0, NOW_NS)
# Of the torques that `found` keeps.
HEARD_S = 10.0


def torque(
    source: TorqueSource, torque_nm: float | None, *, came_s: float = 0.0, way_s: float = 0.0, why: str = ""
) -> TorqueSample:
    """Return a torque that came so long ago, and took so long to come once its acquisition had ended."""
    t_ns = NOW_NS - round(came_s * 1e9)
    acquired_s = 0.5 * max(source.window_s, source.period_s)
    return TorqueSample(source.name, torque_nm, why, t_ns - round((acquired_s + way_s) * 1e9), t_ns)


def faults(
    senses: LatestInputs,
    driving: TorqueSource = EIT,
    supervising: tuple[TorqueSource, ...] = (),
    t_ns: int = NOW_NS,
    required: tuple[str, ...] = (),
    **changes: Any,
) -> list[Fault]:
    """Return what is detected while a gripped tool is twisted, unless something else is said."""
    watched = Watched(driving=driving, supervising=supervising, config=LoopConfig(), required=required)
    step = RunningStep(
        torque_needed=True, lacks_zero=False, grasp=Grasp.HELD, twisted_rad=0.0, expected_nm=None, not_following="",
        overdue=None, others_requests=0,
    )  # fmt: skip
    return detect_faults(senses, watched, ExperimentLimits(), replace(step, **changes), t_ns)


def found(
    *torques: TorqueSample,
    driving: TorqueSource = EIT,
    supervising: tuple[TorqueSource, ...] = (LOAD,),
    arm: ArmStatus = FRESH_ARM,
) -> dict[FaultCode, str]:
    """Return what is detected after these torques.

    As on every rig the wrench supervises too. Where a test does not name it, it has measured the driving torque all
    the time.
    """
    senses = LatestInputs(HEARD_S, arm=arm)
    if WRENCH.name not in [source.name for source in (driving, *supervising)]:
        driven_nm = [one.torque_nm for one in torques if one.source == driving.name and one.torque_nm is not None]
        for number in range(round(HEARD_S / WRENCH.period_s), -1, -1):
            senses.add_torque(torque(WRENCH, driven_nm[-1] if driven_nm else 0.0, came_s=number * WRENCH.period_s))
        supervising = (*supervising, WRENCH)
    for each in torques:
        senses.add_torque(each)
    return {each.code: each.sentence for each in faults(senses, driving, supervising)}


@pytest.mark.parametrize("supervising", [(LOAD, WRENCH), (WRENCH, LOAD)])
@pytest.mark.parametrize("other", [LOAD, WRENCH])
def test_each_supervising_sensor_is_compared_with_the_driving_one(supervising, other):
    heard = [torque(one, -0.1 if one is other else 0.1) for one in (EIT, LOAD, WRENCH)]
    events = found(*heard, supervising=supervising)
    assert events.keys() == {FaultCode.TORQUES_DISAGREE}
    assert f"{other.name} -0.100 N·m" in events[FaultCode.TORQUES_DISAGREE]


def test_no_value_beyond_its_limit_reads_as_the_limit():
    senses = LatestInputs(HEARD_S, arm=FRESH_ARM)
    senses.late_s = LONGEST_HANG_S + 0.001
    limits = ExperimentLimits()
    details = {one.code: one.detail for one in faults(senses, twisted_rad=-limits.angle_rad - 1e-5)}
    assert details[FaultCode.DAEMON_PAUSED] == "it stood still for 0.32 s, and 0.3 s are allowed"
    assert f"turned by {-limits.angle_rad - 1e-5:+.5f} rad" in details[FaultCode.ANGLE_LIMIT]


def test_nothing_is_wrong_while_all_torques_are_new_valid_and_alike():
    assert found(torque(EIT, 0.1), torque(LOAD, 0.1)) == {}


def test_a_supervising_sensor_whose_torque_is_void_holds_the_wrist_and_says_why():
    saturated = torque(LOAD, None, why="the reading is at the end of its range")
    events = found(torque(EIT, 0.1), saturated)
    assert set(events) == {FaultCode.ESTIMATE_INVALID}
    assert "load_cell says: the reading is at the end of its range" in events[FaultCode.ESTIMATE_INVALID]


def test_a_driving_sensor_whose_torque_is_void_is_named_too():
    events = found(torque(EIT, None, why="no signal"), torque(LOAD, 0.1))
    assert "right says: no signal" in events[FaultCode.ESTIMATE_INVALID]


def test_a_torque_that_is_missing_without_a_reason_is_not_quoted():
    assert "right gives no torque." in found(torque(EIT, None), torque(LOAD, 0.1))[FaultCode.ESTIMATE_INVALID]
    no_number = found(torque(EIT, float("nan")), torque(LOAD, 0.1))
    assert "right says: it measured nan, which is no number." in no_number[FaultCode.ESTIMATE_INVALID]


@pytest.mark.parametrize("band", [(0.1, float("nan")), (float("-inf"), 0.1)])
def test_a_band_without_numbers_at_its_ends_is_no_torque(band):
    sample = TorqueSample("skin", 0.1, "", 0, 0, *band)
    assert (sample.torque_nm, sample.low_nm, sample.high_nm) == (None, None, None)
    assert "no number" in sample.reason


def test_what_measures_no_torque_is_watched_for_silence_alone():
    left = TorqueSource(name="left", period_s=0.5412, measures_torque=False)
    heard = torque(EIT, 0.1), torque(LOAD, 0.1)
    supervising = (LOAD, left)
    assert found(*heard, torque(left, None, why="no calibration"), supervising=supervising) == {}
    silent = found(*heard, torque(left, None, came_s=2.0), supervising=supervising)
    assert "the last frame of left came 2.0 s ago" in silent[FaultCode.ESTIMATE_STALE]
    assert "torque" not in silent[FaultCode.ESTIMATE_STALE], "it never had one"


@pytest.mark.parametrize(("measured_nm", "disagree"), [(-0.2, False), (0.2, True)])
def test_a_torque_that_a_one_sided_calibration_reads_as_none_is_no_disagreement(measured_nm, disagree):
    one_sided = replace(EIT, only_sign=1)
    for driving, other in ((one_sided, LOAD), (LOAD, one_sided)):
        events = found(torque(one_sided, 0.0), torque(LOAD, measured_nm), driving=driving, supervising=(other,))
        assert (FaultCode.TORQUES_DISAGREE in events) is disagree
    events = found(torque(one_sided, 0.2), torque(LOAD, -0.1), driving=one_sided, supervising=(LOAD,))
    assert FaultCode.TORQUES_DISAGREE in events, "it reads a torque where there is one of the other sign"


@pytest.mark.parametrize("driving", [EIT, LOAD])
def test_a_disagreement_says_that_another_tool_may_be_held(driving):
    note = "the tool's diameter is not known"
    estimate = replace(torque(EIT, 0.03), note=note)
    supervising = tuple(one for one in (EIT, LOAD) if one is not driving)
    said = found(estimate, torque(LOAD, 0.13), driving=driving, supervising=supervising)
    assert note in said[FaultCode.TORQUES_DISAGREE]
    assert said[FaultCode.TORQUES_DISAGREE].count(note) == 1


@pytest.mark.parametrize("wrench_came_s", [0.0, 0.05, 0.1])
def test_a_disagreement_lasts_where_no_torque_is_of_the_same_moment(wrench_came_s):
    """Two sensors never measure at once: a hold that blinked let the wrist turn in its gaps, and a step end in one."""
    load, wrench = torque(LOAD, 0.15, came_s=0.03), torque(WRENCH, 0.0, came_s=wrench_came_s)
    assert FaultCode.TORQUES_DISAGREE in found(load, wrench, driving=LOAD, supervising=(WRENCH,))


def test_torques_of_other_moments_are_not_compared():
    load, wrench = torque(LOAD, 0.15), torque(WRENCH, 0.0, came_s=0.5)
    assert FaultCode.TORQUES_DISAGREE not in found(load, wrench, driving=LOAD, supervising=(WRENCH,))


@pytest.mark.parametrize("driving", ["left", "right"])
def test_a_fingertip_that_falls_silent_in_a_turn_is_not_compared_with_later_torques_of_the_other(driving):
    """Its last torque is 1.1 s older than the other's newest one; until then the two agree."""
    left, right = replace(EIT, name="left", min_fresh_s=5.0), replace(EIT, min_fresh_s=5.0)
    sources = (left, right) if driving == "left" else (right, left)
    turned = [torque(left, 0.2 - 0.05 * before, came_s=before * EIT.period_s) for before in range(5, -1, -1)]
    turned += [torque(right, 0.2 - 0.05 * before, came_s=before * EIT.period_s + 0.1) for before in range(5, 1, -1)]
    assert FaultCode.TORQUES_DISAGREE not in found(*turned, driving=sources[0], supervising=sources[1:])
    # A disagreement of one moment lasts.
    turned[-1] = replace(turned[-1], torque_nm=0.3)
    assert FaultCode.TORQUES_DISAGREE in found(*turned, driving=sources[0], supervising=sources[1:])


def test_a_wrench_whose_torque_does_not_come_with_the_robots_state_holds_the_wrist_and_says_why():
    """States that come too slowly are fresh, but make no mean: the wrench would supervise nothing, without a word."""
    arm, heard = ArmStatus(0.0, NOW_NS, no_torque="13 states came"), (torque(EIT, 0.1), torque(LOAD, 0.1))
    for before in ((), (torque(WRENCH, 0.1, came_s=0.2),)):
        for driving, supervising in ((EIT, (LOAD, WRENCH)), (WRENCH, (LOAD,))):
            events = found(*heard, *before, driving=driving, supervising=supervising, arm=arm)
            assert events.keys() == {FaultCode.WRENCH_UNKNOWN}
            assert "a torque of its wrench: 13 states came. " in events[FaultCode.WRENCH_UNKNOWN]
            assert "lower `rate_hz` of the robot's settings" in events[FaultCode.WRENCH_UNKNOWN]
            assert "cable" not in events[FaultCode.WRENCH_UNKNOWN], "it has none of its own"


def test_a_wrench_without_a_state_of_the_robot_is_no_second_fault():
    heard = (torque(EIT, 0.1), torque(LOAD, 0.1), torque(WRENCH, 0.1, came_s=0.9))
    silent = ArmStatus(0.0, NOW_NS - round(0.9e9))
    assert found(*heard, supervising=(LOAD, WRENCH), arm=silent).keys() == {FaultCode.STATE_STALE}


@pytest.mark.parametrize("later_nm", [0.15, 0.2])
def test_a_disagreement_lasts_until_a_comparison_agrees(later_nm):
    """The wrench has a gap: no torque of it is near the load cell's latest ones, which grow without a break."""
    heard = [torque(WRENCH, 0.0, came_s=0.4 - 0.04 * number) for number in range(5)]
    heard += [torque(LOAD, later_nm if number else 0.15, came_s=0.4 - 0.09 * number) for number in range(5)]
    patient = replace(WRENCH, min_fresh_s=5.0)
    assert found(*heard, driving=LOAD, supervising=(patient,)).keys() == {FaultCode.TORQUES_DISAGREE}
    # The next pair agrees.
    heard += [torque(WRENCH, later_nm), torque(LOAD, later_nm)]
    assert found(*heard, driving=LOAD, supervising=(patient,)) == {}


def test_a_disagreement_lasts_while_a_sensor_is_void():
    """Else a sensor that is void now and then would let the disagreement's hold run down."""
    before = [torque(WRENCH, 0.0, came_s=0.1), torque(LOAD, 0.3, came_s=0.1)]
    void = torque(LOAD, None, why="a spike")
    events = found(*before, torque(WRENCH, 0.0), void, driving=LOAD, supervising=(WRENCH,))
    assert events.keys() == {FaultCode.ESTIMATE_INVALID, FaultCode.TORQUES_DISAGREE}


def test_two_sensors_that_cannot_be_compared_do_not_supervise_each_other():
    patient = replace(WRENCH, min_fresh_s=1.0)
    heard = torque(LOAD, 0.1), torque(WRENCH, 0.1, came_s=0.9)
    events = found(*heard, driving=LOAD, supervising=(patient,))
    assert "wrench" in events[FaultCode.ESTIMATE_INVALID]
    assert events.keys() == {FaultCode.ESTIMATE_INVALID}


@pytest.mark.parametrize("source", [EIT, LOAD])
def test_a_torque_that_comes_in_time_but_is_of_long_ago_is_late_by_the_computer(source):
    """As from an estimator that has fallen behind: eight frames wait for it, and one comes in each period."""
    fresh = {one.name: torque(one, 0.1) for one in (EIT, LOAD)}
    late = torque(source, 0.1, way_s=8 * source.period_s)
    events = found(*{**fresh, source.name: late}.values())
    assert events.keys() == {FaultCode.ESTIMATE_LATE}
    sentence = events[FaultCode.ESTIMATE_LATE]
    assert f"the last torque of {source.name} was measured" in sentence
    assert f"it took {8.5 * source.period_s:.1f} s to come" in sentence
    assert "cable" not in sentence
    assert "the computer or its matching is too slow" in sentence


@pytest.mark.parametrize("came_s", [1.9, 2.0])
def test_a_torque_that_came_on_time_before_its_sensor_fell_silent_is_no_fault_of_the_computer(came_s):
    """From 1.9 s on it is too old by its measurement, and then by its arrival."""
    events = found(torque(EIT, 0.1, came_s=came_s, way_s=0.3), torque(LOAD, 0.1))
    assert events.keys() == {FaultCode.ESTIMATE_STALE}


def test_an_estimator_whose_next_torque_is_not_there_yet_is_late_and_its_sensor_not_silent():
    events = found(torque(EIT, 0.1, came_s=2.0, way_s=4.0), torque(LOAD, 0.1))
    assert events.keys() == {FaultCode.ESTIMATE_LATE}


@pytest.mark.parametrize("source", [EIT, LOAD, replace(EIT, window_s=5 * EIT.period_s)])
def test_a_frame_that_is_missed_and_a_mean_of_several_are_borne(source):
    """Half an acquisition, a tenth of a period on the way, and two periods since: one frame was missed."""
    patient = torque(source, 0.1, came_s=2.0 * source.period_s, way_s=0.1 * source.period_s)
    assert found(patient, driving=source, supervising=()) == {}


def test_a_torque_that_counts_as_new_is_held_against_its_limit():
    """Beyond 2.5 of its short periods, and younger than `min_fresh_s`."""
    quick = replace(LOAD, period_s=0.005, min_fresh_s=0.1)
    beyond = torque(quick, 0.9, came_s=0.05)
    assert found(beyond, driving=quick, supervising=()).keys() == {FaultCode.TORQUE_LIMIT}


def test_means_that_lie_before_a_single_frame_are_the_latest_and_judged_and_do_not_disorder_the_history():
    """A refused frame is no mean; the mean of ten frames that comes next lies four periods before it."""
    senses, way_s = LatestInputs(10.0, arm=ArmStatus(0.0, NOW_NS)), 4.0 * EIT.period_s
    senses.add_torque(torque(EIT, 0.1, came_s=2.0, way_s=way_s))
    senses.add_torque(torque(EIT, None, came_s=1.0, why="200 channels cannot be used"))
    mean = torque(EIT, 0.2, way_s=way_s)
    senses.add_torque(mean)
    assert senses.torques[EIT.name] is mean
    assert [one.torque_nm for one in senses.unjudged] == [0.1, 0.2]
    early = torque(EIT, 0.3, way_s=way_s + 1.0)
    senses.add_torque(early)
    times_ns, torques_nm = senses.history[EIT.name]
    assert times_ns == sorted(times_ns)
    assert torques_nm == [0.1, 0.2]
    assert senses.torques[EIT.name] is early


@pytest.mark.parametrize("rate_hz", [10.9, 80.0, 1000.0])
def test_torques_are_compared_for_as_long_as_the_slower_one_counts_as_new(rate_hz):
    """Else a disagreement would come and go with every frame, and a hold would never become a stop."""
    quick = replace(LOAD, period_s=1.0 / rate_hz)
    kept_s = compared_for_s((EIT, quick))
    senses = LatestInputs(kept_s, arm=ArmStatus(0.0, NOW_NS))
    frame = torque(EIT, 0.1, came_s=2.4 * EIT.period_s)
    senses.add_torque(frame)
    for number in range(round(60 * rate_hz), 0, -1):
        senses.add_torque(torque(quick, 0.3, came_s=(number - 1) / rate_hz))
    (trouble,) = faults(senses, EIT, (quick,))
    assert trouble.code is FaultCode.TORQUES_DISAGREE
    assert len(senses.history[LOAD.name][0]) <= 10 * rate_hz, "and the rest is forgotten"


LOST = {"robot": "No UR controller at 10.0.0.1. Check that it is on.", "gripper": "There is no gripper socket."}


def devices(
    lost: dict[str, str], *, arm: ArmStatus | None = None, hand: GripperStatus | None = None
) -> list[tuple[FaultCode, str]]:
    """Return what is said of the devices while nothing moves."""
    senses = LatestInputs(10.0, arm=arm, gripper=hand, lost=lost)
    found = faults(senses, torque_needed=False, grasp=Grasp.NONE, required=("robot", "gripper"))
    return [(each.code, each.detail) for each in found]


def test_devices_that_were_never_there_are_awaited_in_one_sentence():
    assert devices({}) == [(FaultCode.DEVICE_AWAITED, "robot; gripper")]
    both = "robot, No UR controller at 10.0.0.1. Check that it is on; gripper, There is no gripper socket"
    assert devices(LOST) == [(FaultCode.DEVICE_AWAITED, both)]


def test_a_device_that_was_there_is_gone_beside_one_that_was_never_there():
    arm, hand = ArmStatus(0.0, NOW_NS), GripperStatus(NOW_NS, 30.0, holding=False, moving=False)
    assert devices(LOST, arm=arm, hand=hand) == [
        (FaultCode.ROBOT_LOST, LOST["robot"]),
        (FaultCode.DEVICE_LOST, f"gripper: {LOST['gripper']}"),
    ]
    assert devices({"gripper": LOST["gripper"]}, arm=arm) == [
        (FaultCode.DEVICE_AWAITED, "gripper, There is no gripper socket")
    ]
    assert [event for event, _ in devices(LOST, hand=hand)] == [FaultCode.DEVICE_AWAITED, FaultCode.DEVICE_LOST]


def test_a_robot_that_is_gone_or_does_not_move_is_not_plugged_in_again():
    died = "The worker died of SIGKILL while controlling. The process is started again with motion disabled."
    blocked = ArmStatus(0.0, NOW_NS, blocked="Motion has not been enabled since the worker was started.")
    for senses in (
        LatestInputs(10.0, arm=ArmStatus(0.0, NOW_NS), lost={"robot": died}),
        LatestInputs(10.0, arm=blocked),
    ):
        (trouble,) = faults(senses, torque_needed=False, required=("robot",))
        assert trouble.rule.response is Response.STOP_AND_KEEP_GRIP
        assert trouble.code in (FaultCode.ROBOT_LOST, FaultCode.ROBOT_BLOCKED)
        assert "`shearloop command unlock`" in trouble.rule.cure
        assert "lug" not in trouble.sentence


def test_a_sensor_that_was_never_there_is_not_gone():
    senses = LatestInputs(10.0, arm=ArmStatus(0.0, NOW_NS), lost={"right": "There is no port."})
    (trouble,) = faults(senses)
    assert trouble.detail == "right is not connected yet: There is no port."
    senses.add_torque(torque(EIT, 0.1))
    (trouble,) = faults(senses)
    assert trouble.detail == "right is gone: There is no port."
    senses.lost["right"] = ""
    (trouble,) = faults(senses)
    assert trouble.detail == "right is gone: ", "though it does not say why"


def test_a_loop_that_was_away_for_long_was_not_too_slow():
    senses = LatestInputs(10.0, arm=ArmStatus(0.0, NOW_NS))
    for late_s, event in ((0.27, FaultCode.LOOP_LATE), (0.29, FaultCode.DAEMON_PAUSED), (3.0, FaultCode.DAEMON_PAUSED)):
        senses.late_s = late_s
        (trouble,) = faults(senses, torque_needed=False)
        assert trouble.code is event
    assert "it stood still for 3.0 s" in trouble.detail
    assert "overload" in trouble.rule.cure, "what follows from it is not told, and may be all that would say so"


def test_states_that_come_late_for_good_are_stale_for_long_enough_to_stop_the_wrist():
    """A fifth of a second late, until it is taken for the controller's clock."""
    age, stale_s = SampleAge(), 0.0
    for number in range(2000):
        made_s = 0.008 * number
        late_s = 0.2 if number >= 100 else 0.001
        stale_s += 0.008 * (age.age_ns(made_s, round((made_s + late_s) * 1e9)) > ARM_STALE_S * 1e9)
    assert stale_s == pytest.approx(9.7, abs=0.1)
    assert stale_s > (TABLE[FaultCode.STATE_STALE].hold_at_most_s or 0.0) + 1.0


@pytest.mark.parametrize("rate_hz", [100.0, 125.0, 500.0])
@pytest.mark.parametrize("slow_hz", [8.0, 10.0, 10.9])
def test_each_sample_is_compared_with_a_wrench(rate_hz, slow_hz):
    """A slower sensor that disagrees does so at each of its samples: else the wrist would turn on until the next."""
    wrench, slow = wrench_source(rate_hz), TorqueSource(name="load_cell", period_s=1 / slow_hz)
    senses, sample = LatestInputs(10.0), 0.5
    compared = []
    for cycle in range(round(20.0 * rate_hz)):
        t_ns = NOW_NS + round(cycle / rate_hz * 1e9)
        senses.arm = ArmStatus(0.0, t_ns)
        if cycle % publish_every(rate_hz) == 0:
            senses.add_torque(TorqueSample("wrench", 0.1, "", t_ns, t_ns))
        measured_ns = NOW_NS + round((sample - 0.5) / slow_hz * 1e9)
        if t_ns >= NOW_NS + round(sample / slow_hz * 1e9):
            senses.add_torque(TorqueSample("load_cell", 0.3, "", measured_ns, t_ns))
            sample += 1.0
            events = faults(senses, slow, (wrench,), t_ns)
            compared.append(FaultCode.TORQUES_DISAGREE in {each.code for each in events})
    assert len(compared) > 150
    assert all(compared[1:])


def test_a_step_that_is_overdue_says_what_slows_the_robot():
    slowed = ("wrist 3 at 6.1 rad is near the end of its range",)
    senses = LatestInputs(HEARD_S, arm=replace(FRESH_ARM, slowed_by=slowed))
    (fault,) = [
        one
        for one in faults(senses, overdue="step 2 (tighten) has taken 61 s of at most 60 s")
        if one.code is FaultCode.STEP_OVERDUE
    ]
    assert fault.detail == f"step 2 (tighten) has taken 61 s of at most 60 s; {slowed[0]}"


@pytest.mark.parametrize(
    ("driving", "device", "why"),
    [(LOAD, LOAD.name, "It is unplugged."), (WRENCH, "robot", "The connection is lost."), (WRENCH, LOAD.name, "")],
)
def test_a_lost_zero_names_the_loss_that_took_it(driving, device, why):
    senses = LatestInputs(HEARD_S, arm=FRESH_ARM, lost={device: why or "Another device is unplugged."})
    (fault,) = (one for one in faults(senses, driving=driving, lacks_zero=True) if one.code is FaultCode.ZERO_LOST)
    gone = f"{driving.name} is gone, and its zero with it: {why.removesuffix('.')}"
    assert fault.detail == gone if why else "or its zero was not taken" in fault.detail
