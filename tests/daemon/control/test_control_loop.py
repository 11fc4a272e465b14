"""The control loop when all is well: whole experiments, and what an operator may ask of one."""

import math
from copy import copy
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from shearloop.daemon.control.control_loop import ControlLoop, End
from shearloop.daemon.control.experiment import ExperimentPhase
from shearloop.daemon.control.experiment_schema import ApproachStep, ExperimentFile, GripStep, Opening, TareStep
from shearloop.daemon.control.faults import Fault, FaultCode, Response
from shearloop.daemon.control.grip import Grip
from shearloop.daemon.control.inputs import ArmStatus, GripperStatus
from shearloop.daemon.control.operator_view import release_question
from shearloop.daemon.control.state_publisher import loop_state
from shearloop.daemon.control.torque_controller import ControllerReason
from shearloop.daemon.control.wrench import wrench_source
from shearloop.daemon.loop_config import LoopConfig
from shearloop.daemon.operator_questions import file_refusal
from shearloop.daemon.torques import TorqueSample, beyond_noise
from tests.daemon.control.loop_rig import CONFIG, EIT, GRIP, LOAD, TICK_S, Rig, new_loop, phase, speed_of, started, stop


@pytest.mark.parametrize("drive", ["right", "load_cell"])
def test_the_loop_grips_identifies_holds_a_torque_and_lets_go(drive):
    rig = started(
        Rig(new_loop()),
        {"do": "approach", "pose_m_rad": [0.4, 0, 0.3, 0, 3.1, 0]},
        {"do": "tare"},
        GRIP,
        {"do": "identify"},
        {"do": "hold_torque", "torque_nm": 0.1, "hold_s": 20},
        {"do": "release"},
        torque_source=drive,
    )
    rig.run(200)
    assert phase(rig) is ExperimentPhase.DONE, rig.control_loop.experiment.stop_reason
    assert [type(action) for action in rig.begun] == [ApproachStep, TareStep, GripStep, Opening]
    held = np.array(rig.true_nm)[-round(15 / TICK_S) - 110 : -110]
    assert held.mean() == pytest.approx(0.1, abs=0.008)
    assert held.std() < 0.006


def test_a_load_cell_identifies_as_well_in_a_third_of_the_time():
    found = []
    for hold_s in (0.8, 2.5):
        step = {"do": "identify", "amplitude_rad": 0.1, "hold_s": hold_s}
        rig = started(Rig(new_loop()), GRIP, step, {"do": "wait", "wait_s": 0.1}, torque_source="load_cell")
        rig.run(60)
        assert phase(rig) is ExperimentPhase.DONE
        found.append(rig.control_loop.wrist.tool.stiffness_nm_per_rad)
    assert found[0] == pytest.approx(found[1], rel=0.01)


def holding(drive: str, config: LoopConfig = CONFIG) -> Rig:
    """Return a rig that has reached its torque and holds it."""
    hold = {"do": "hold_torque", "torque_nm": 0.1, "hold_s": 60}
    rig = started(Rig(new_loop(config)), GRIP, {"do": "identify"}, hold, {"do": "release"}, torque_source=drive)
    while not rig.control_loop.experiment.command.hold_number:
        rig.step()
    rig.run(5)
    return rig


@pytest.mark.parametrize("stale_after_s", [0.1, 2.0])
@pytest.mark.parametrize("drive", ["right", "load_cell"])
def test_a_closed_loop_that_rests_for_want_of_a_torque_reports_the_fault(drive, stale_after_s):
    config = LoopConfig(stale_after_s=stale_after_s)
    rig = holding(drive, config)
    rig.silent.add(drive)
    silent_from_s = rig.t_ns / 1e9
    while rig.control_loop.status.phase != "held":
        assert ControllerReason.STALE not in rig.control_loop.status.velocity.reasons
        rig.step()
    assert rig.control_loop.status.decision.faults[0].code is FaultCode.ESTIMATE_STALE
    source = {"right": EIT, "load_cell": LOAD}[drive]
    fresh_s = max(2.5 * source.period_s, stale_after_s)
    # The last torque came up to a period before.
    assert fresh_s - source.period_s - TICK_S <= rig.t_ns / 1e9 - silent_from_s <= fresh_s + 2 * TICK_S


def slip(rig: Rig, rate_rad_per_s: float, most_rad: float) -> None:
    """Leave the tool behind the fingers from now on, by more and more."""
    turned, begun = rig.twin.step, rig.tick

    def slipping(step_s: float, wrist_rad: float, force_n: float) -> Any:
        slipped_rad = min(most_rad, rate_rad_per_s * (rig.tick - begun) * TICK_S)
        return turned(step_s, wrist_rad - slipped_rad, force_n)

    rig.twin = SimpleNamespace(step=slipping)


def assert_stopped_because_the_torque_does_not_follow(rig: Rig) -> None:
    assert phase(rig) is ExperimentPhase.STOPPED
    assert "the torque no longer follows the wrist: at one angle it moved by -0." in rig.control_loop.status.activity


@pytest.mark.parametrize("drive", ["right", "load_cell"])
def test_a_tool_that_slips_while_a_torque_is_held_ends_in_a_stop_and_not_as_done(drive):
    rig = holding(drive)
    slip(rig, rate_rad_per_s=0.1, most_rad=0.35)
    rig.run(60)
    assert_stopped_because_the_torque_does_not_follow(rig)
    assert rig.control_loop.safety.waiting.faults[0].code is FaultCode.NOT_FOLLOWING
    assert rig.true_nm[-1] < 0.05


MISSING = "There is no serial port /dev/load; no USB serial port is plugged in."


@pytest.mark.parametrize("gone", ["right", "load_cell"])
@pytest.mark.parametrize("drive", ["right", "load_cell"])
@pytest.mark.parametrize("how", ["unplugged", "silent", "never there"])
def test_a_sensor_that_is_gone_or_silent_refuses_what_needs_torques_before_anything_moves(how, drive, gone):
    loop = ControlLoop(CONFIG, {"right": EIT, "load_cell": LOAD}, ("gripper",))
    rig = Rig(loop)
    if how == "never there":
        rig.silent.add(gone)
    rig.run(2)
    rig.silent.add(gone)
    if how == "unplugged":
        loop.on_link(gone, MISSING, up=False)
    rig.run(2)
    cause = {
        "unplugged": f"a sensor is not connected: {gone} is gone: {MISSING[:-1]}. Connect it again",
        "silent": f"a sensor has sent nothing new: the last torque of {gone} came 2.",
        "never there": f"a sensor has sent nothing new: {gone} has not measured anything yet. Check the sensor's cable",
    }[how]
    for step in ({"do": "tare"}, {"do": "identify"}, {"do": "tighten", "until_torque_nm": 0.1, "until_angle_rad": 1}):
        if step["do"] == "tighten":
            step["direction"] = "clockwise"
        needing = ExperimentFile.model_validate({"name": "test", "steps": [GRIP, step], "torque_source": drive})
        refusal = loop.start(needing, rig.t_ns)
        assert (refusal or "").startswith(cause), step["do"]
        assert file_refusal(loop.operator, needing) == refusal
    adapts = {"do": "adapt", "fingertip": "right", "reference": "load_cell"}
    assert file_refusal(loop.operator, ExperimentFile.model_validate({"name": "test", "steps": [adapts]}))
    steps = [GRIP, {"do": "wait", "wait_s": 1}, {"do": "release"}]
    assert loop.start(ExperimentFile(name="test", steps=steps, torque_source=drive), rig.t_ns) is None


@pytest.mark.parametrize("named", ["right", "absent"])
def test_an_experiment_that_only_grips_runs_without_a_torque_of_its_source_and_the_others_watch_it(named):
    sources = {"right": replace(EIT, measures_torque=False), "load_cell": replace(LOAD, needs_zero=True)}
    wait = {"do": "wait", "wait_s": 1}
    for load_nm in (0.0, 1.0):
        rig = started(
            Rig(ControlLoop(CONFIG, sources, ("gripper",))), GRIP, wait, {"do": "release"}, torque_source=named
        )
        assert loop_state(rig.control_loop, 0.0, rig.t_ns).torque_source == "load_cell"
        rig.twin = SimpleNamespace(step=lambda *_, nm=load_nm: SimpleNamespace(torque_nm=nm, shear_torque_nm=nm))
        rig.run(20)
        assert phase(rig) is (ExperimentPhase.STOPPED if load_nm else ExperimentPhase.DONE)
    assert rig.control_loop.safety.waiting.faults[0].code is FaultCode.TORQUE_LIMIT


def test_a_loop_turns_a_tool_by_the_named_torque_alone():
    rig = Rig(new_loop())
    rig.run(2)
    file = ExperimentFile.model_validate({"name": "test", "steps": [GRIP, {"do": "identify"}], "torque_source": "left"})
    with pytest.raises(KeyError):
        rig.control_loop.start(file, rig.t_ns)


@pytest.mark.parametrize("stood_s", [0.12, 0.34, 0.9])
@pytest.mark.parametrize("decided_since", [False, True])
def test_states_that_are_old_because_the_daemon_stood_still_are_not_blamed_on_a_cable(stood_s, decided_since):
    rig = Rig(new_loop())
    rig.run(2)
    rig.tick += round(stood_s / TICK_S)
    file = ExperimentFile.model_validate({"name": "test", "steps": [{"do": "release"}]})
    if decided_since:
        rig.silent |= {"arm", "hand"}
        rig.step()
    said = rig.control_loop.start(file, rig.t_ns) or ""
    assert said == f"the daemon stood still for {stood_s:.1f} s: look at the rig, and send the command again"
    # What is still silent a while later is.
    rig.silent.add("arm")
    rig.run(2)
    assert "the robot last reported its state" in (rig.control_loop.start(file, rig.t_ns) or "")


def pause_for(rig: Rig, seconds: float) -> None:
    assert rig.control_loop.pause() is None
    rig.run(seconds)
    assert rig.control_loop.resume() is None


def lose_the_load_cell_for(rig: Rig, seconds: float) -> None:
    rig.silent.add("load_cell")
    rig.run(seconds)
    assert rig.control_loop.status.decision.response is Response.HOLD
    rig.silent.clear()


@pytest.mark.parametrize("hold", [pause_for, lose_the_load_cell_for])
def test_a_hold_forgives_no_slip(hold):
    rig = holding("load_cell")
    begun_rad = rig.wrist_rad
    for _ in range(4):
        slip(rig, rate_rad_per_s=0.1, most_rad=0.15)
        rig.run(5)
        if rig.control_loop.status.decision.faults:
            break
        hold(rig, 2.0)
    rig.run(20)
    assert_stopped_because_the_torque_does_not_follow(rig)
    assert abs(rig.wrist_rad - begun_rad) < 0.45


def test_a_tighter_grip_of_the_same_tool_keeps_the_angle_of_the_grip():
    twist = {"do": "twist", "angles_rad": [0.13], "return_to_start": False, "hold_s": 0.5}
    limits = {"torque_nm": 1.0, "angle_rad": 0.2}
    again = {**twist, "angles_rad": [0.19]}
    rig = started(
        Rig(new_loop()), GRIP, twist, {**GRIP, "force_n": 100.0}, again, torque_source="load_cell", limits=limits
    )
    begun_rad = rig.wrist_rad
    rig.run(60)
    assert phase(rig) is ExperimentPhase.DONE, rig.control_loop.experiment.stop_reason
    assert rig.wrist_rad - begun_rad == pytest.approx(0.19, abs=0.01), "the second twist counts from the same grip"
    assert rig.control_loop.tool.grip.force_n == 100.0


def test_each_message_has_the_step_that_its_activity_belongs_to():
    """The end of a measurement begins the next step within the same decision."""
    hold = {"do": "hold_torque", "torque_nm": 0.1, "hold_s": 1}
    rig = started(Rig(new_loop()), GRIP, {"do": "identify"}, hold, {"do": "release"}, torque_source="load_cell")
    told: dict[str, set[int]] = {}
    while phase(rig) is ExperimentPhase.RUNNING:
        rig.step()
        message = loop_state(rig.control_loop, 0.0, rig.t_ns)
        told.setdefault(message.activity.split(",")[0], set()).add(message.step)
    assert told["measuring the tool's stiffness"] == {2}
    assert told["bringing the torque to +0.100 N·m"] == {3}
    assert [activity for activity, steps in told.items() if len(steps) > 1] == []


@pytest.mark.long
def test_tool_that_was_turned_after_an_experiment_is_identified_again():
    rig = started(Rig(new_loop()), GRIP, {"do": "identify"}, {"do": "hold_torque", "torque_nm": 0.15, "hold_s": 60})
    while not rig.control_loop.experiment.command.hold_number:
        rig.step()
    stop(rig)
    rig.control_loop.acknowledge()
    rig.wrist_rad -= 0.6
    started(rig, {"do": "identify"}, {"do": "wait", "wait_s": 60})
    while rig.control_loop.experiment.step_number == 1 and phase(rig) is ExperimentPhase.RUNNING:
        rig.step()
    assert rig.control_loop.experiment.step_number == 2, rig.control_loop.status.activity


def test_every_torque_between_two_ticks_has_to_be_within_the_limit():
    rig = started(Rig(new_loop()), GRIP, {"do": "wait", "wait_s": 60})
    for later_ns, torque_nm in enumerate((0.0, 1.5, 0.0), 1):
        t_ns = rig.t_ns + later_ns
        rig.control_loop.on_torque(TorqueSample("load_cell", torque_nm, "", t_ns, t_ns))
    rig.step()
    assert "load_cell measured +1.500 N·m" in rig.control_loop.experiment.stop_reason


def test_loop_state_has_the_filtered_torque_and_its_standard_deviation():
    hold = {"do": "hold_torque", "torque_nm": 0.1, "hold_s": 60}
    rig = started(Rig(new_loop()), GRIP, {"do": "identify"}, hold, torque_source="load_cell")
    while rig.control_loop.wrist.controller is None:
        assert loop_state(rig.control_loop, 0.0, 0).filtered_torque_std_nm is None
        rig.run(1)
    rig.run(10)
    state = loop_state(rig.control_loop, 0.0, 0)
    assert state.filtered_torque_nm == pytest.approx(rig.true_nm[-1], abs=0.003)
    assert 0.0 < state.filtered_torque_std_nm < 0.002


@pytest.mark.parametrize("number", [3, 4, 5])
def test_two_holds_that_differ_only_in_their_limit_have_each_its_own(number):
    """A torque of 0.25 N·m is beyond the limit of the second hold alone."""
    hold = {"do": "hold_torque", "torque_nm": 0.1, "hold_s": 5}
    holds = [{**hold, "limits": {"torque_nm": limit}} for limit in (0.3, 0.2, 0.4)]
    rig = started(
        Rig(new_loop()), GRIP, {"do": "identify"}, *holds, torque_source="load_cell", limits={"torque_nm": 0.5}
    )
    while rig.control_loop.experiment.step_number < number:
        rig.step()
    rig.step()
    rig.control_loop.on_torque(TorqueSample("right", 0.25, "", rig.t_ns, rig.t_ns))
    rig.step()
    assert ("torque limit" in rig.control_loop.status.decision.codes) is (number == 4)


def test_an_angle_that_is_not_a_number_stops_the_turn():
    rig = twisting()
    rig.control_loop.on_arm(ArmStatus(math.nan, rig.t_ns))
    rig.control_loop.tick(rig.t_ns + 1)
    assert rig.control_loop.status.decision.codes == "robot blocked"
    assert phase(rig) is ExperimentPhase.STOPPED


def test_an_angle_that_is_not_a_number_in_a_stale_state_begins_no_angle_of_the_tool():
    """The state is held as stale before anything says that it blocks; the angle limit counts from a number."""
    rig = started(Rig(new_loop()), {"do": "wait", "wait_s": 1}, GRIP, TWIST)
    rig.silent.add("arm")
    rig.tick += 10
    rig.control_loop.on_arm(ArmStatus(math.nan, rig.t_ns - 100_000_000))
    rig.step()
    assert rig.control_loop.status.decision.codes == "state stale"
    assert rig.control_loop.tool.grip.origin_rad == pytest.approx(rig.wrist_rad)


@pytest.mark.parametrize(
    ("adapted", "drive", "refused"), [(None, "right", True), ("right", "right", True), ("right", "load_cell", False)]
)
def test_a_set_point_without_identification_at_its_gain_is_refused_with_the_cure(adapted, drive, refused):
    first = [{"do": "identify"}, {"do": "adapt", "fingertip": adapted}] if adapted else []
    rig = started(Rig(new_loop()), GRIP, *first, {"do": "hold_torque", "torque_nm": 0.1}, torque_source=drive)
    rig.run(100)
    if not refused:
        assert phase(rig) is ExperimentPhase.DONE
        return
    assert phase(rig) is ExperimentPhase.STOPPED
    assert "put an `identify` step before" in rig.control_loop.experiment.stop_reason


def _gone(device: str):
    return lambda rig: rig.control_loop.on_link(device, f"the {device} is unplugged", up=False)


HINDRANCES = {
    "a full disk": lambda rig: rig.control_loop.on_recording_error("/data: No space left on device"),
    "no gripper": _gone("gripper"),
    "a required sensor": _gone("right"),
    "a dead task": lambda rig: setattr(rig.control_loop.inputs, "died", {"load_cell": "ValueError: no"}),
    "an emergency stop": lambda rig: setattr(rig, "arm", replace(rig.arm, emergency_stop=True)),
    "a blocked arm": lambda rig: setattr(rig, "arm", replace(rig.arm, blocked="it is switched off")),
    "a faulty gripper": lambda rig: setattr(rig, "hand", replace(rig.hand, fault="it is too hot")),
    "a silent arm": lambda rig: rig.silent.add("arm"),
}


@pytest.mark.parametrize("hindrance", HINDRANCES)
def test_what_refuses_every_start_is_said_before_the_start_in_the_same_words(hindrance):
    rig = Rig(new_loop())
    rig.run(1.0)
    assert rig.control_loop.start_refusal() is None
    HINDRANCES[hindrance](rig)
    rig.run(1.0)
    before = rig.control_loop.start_refusal()
    assert before
    file = ExperimentFile.model_validate({"name": "test", "steps": [{"do": "wait", "wait_s": 1}]})
    assert rig.control_loop.start(file, rig.t_ns) == before


def test_an_arm_that_the_start_enables_refuses_none():
    rig = Rig(new_loop())
    rig.arm = replace(rig.arm, blocked="motion is not enabled", enabled_by_start=True)
    rig.run(1.0)
    assert rig.control_loop.start_refusal() is None


def test_a_pause_holds_the_wrist_and_is_refused_with_the_reason():
    rig = twisting()
    assert rig.control_loop.pause() is None
    rig.step()
    assert rig.speed == 0.0
    assert "paused already" in (rig.control_loop.pause() or "")
    assert rig.control_loop.resume() is None
    rig.step()
    assert rig.speed > 0.0
    stop(rig)
    assert rig.control_loop.pause() == "no experiment is running"


TWIST = {"do": "twist", "angles_rad": [0.2]}


def twisting() -> Rig:
    """Return a rig in the middle of a slow twist."""
    slowly = {"do": "twist", "angles_rad": [0.5], "speed_rad_per_s": 0.01, "hold_s": 60}
    rig = started(Rig(new_loop()), GRIP, slowly)
    rig.run(5)
    assert rig.speed > 0
    return rig


@pytest.mark.parametrize("step", [GRIP, {**GRIP, "expect_object": False}, {"do": "release", "width_mm": 20}])
def test_a_tool_that_is_taken_away_is_noticed_though_nobody_expected_it(step):
    rig = Rig(new_loop())
    rig.meets = True
    started(rig, step, {"do": "twist", "angles_rad": [0.2], "hold_s": 60})
    rig.run(5)
    assert phase(rig) is ExperimentPhase.RUNNING
    rig.force_n = 0.0
    rig.step()
    assert FaultCode.GRIP_LOST in {trouble.code for trouble in rig.control_loop.status.decision.faults}
    assert phase(rig) is ExperimentPhase.STOPPED


@pytest.mark.parametrize(
    ("sense", "force_n", "does", "note"),
    [
        ({}, 60.0, "its fingers hold something 19.7 mm wide", True),
        ({"moving": True}, 0.0, "its fingers move, 19.7 mm apart", False),
        ({}, 0.0, "its fingers are 19.7 mm apart with nothing between them", False),
    ],
)
def test_a_gripper_that_another_program_commands_stops_the_twist_and_says_what_it_holds(sense, force_n, does, note):
    """A request from the pendant before the start is none of the experiment's; one during it is."""
    rig = Rig(new_loop())
    rig.hand = replace(rig.hand, others_requests=1)
    rig.meets = True
    started(rig, GRIP, {"do": "twist", "angles_rad": [0.5], "speed_rad_per_s": 0.01, "hold_s": 60})
    rig.run(5)
    assert phase(rig) is ExperimentPhase.RUNNING
    assert "30.0 mm wide, with at most 60 N" in release_question(rig.control_loop.operator)
    rig.hand, rig.force_n, rig.width_mm = replace(rig.hand, others_requests=2, **sense), force_n, 19.7
    rig.step()
    assert phase(rig) is ExperimentPhase.STOPPED
    (fault,) = rig.control_loop.status.decision.reported
    assert fault.cause == f"another program, or the pendant, commands the gripper: {does}"
    rig.step()
    codes = [fault.code for fault in rig.control_loop.status.decision.reported]
    assert (FaultCode.TOOL_GRIPPED in codes) is note
    question = release_question(rig.control_loop.operator)
    assert ("hold something 19.7 mm wide, with an unknown force" in question) is note
    assert ("the gripper reports no object" in question) is not note


def test_what_another_program_asked_before_a_start_does_not_stop_it_again():
    """The operator unlocks and starts before the gripper has reported once more."""
    rig = started(Rig(new_loop()), {"do": "wait", "wait_s": 60})
    rig.run(1)
    rig.hand = replace(rig.hand, others_requests=1)
    rig.step()
    assert phase(rig) is ExperimentPhase.STOPPED
    rig.control_loop.acknowledge()
    again = ExperimentFile.model_validate({"name": "again", "steps": [{"do": "wait", "wait_s": 60}]})
    assert rig.control_loop.start(again, rig.t_ns) is None
    rig.run(1)
    assert phase(rig) is ExperimentPhase.RUNNING


def test_the_question_whether_an_experiment_can_begin_changes_nothing():
    """A start asks it several times, and the grip of before is judged by the start alone."""
    judged: list[str] = []
    rig = started(Rig(new_loop()), GRIP, {"do": "wait", "wait_s": 60})
    rig.run(2)
    tool = rig.control_loop.tool
    tool.restore_grip(tool.grip, judged.append)
    rig.hand = replace(rig.hand, others_requests=1)
    rig.step()
    assert phase(rig) is ExperimentPhase.STOPPED
    rig.control_loop.acknowledge()
    before = copy(tool)
    again = ExperimentFile.model_validate({"name": "again", "steps": [{"do": "wait", "wait_s": 60}]})
    for _ in range(3):
        rig.control_loop.refusal_of(again, rig.t_ns)
    assert (tool, judged) == (before, [])
    assert rig.control_loop.start(again, rig.t_ns) is None
    assert judged == ["another program, or the pendant, has commanded it since then"]
    assert rig.control_loop.start(again, rig.t_ns) == "the experiment 'again' is running; stop it first"


def test_a_refused_start_accepts_no_request_of_others_during_an_experiment():
    rig = started(Rig(new_loop()), {"do": "wait", "wait_s": 60})
    rig.run(1)
    rig.hand = replace(rig.hand, others_requests=1)
    rig.sense(0.0)
    again = ExperimentFile.model_validate({"name": "again", "steps": [{"do": "wait", "wait_s": 60}]})
    assert "is running" in rig.control_loop.start(again, rig.t_ns)
    rig.step()
    assert phase(rig) is ExperimentPhase.STOPPED


@pytest.mark.parametrize("seen_moving", [False, True])
def test_a_grip_that_another_program_has_changed_has_neither_our_force_nor_our_angle(seen_moving):
    rig = started(Rig(new_loop()), GRIP, {"do": "wait", "wait_s": 60})
    rig.run(2)
    stop(rig)
    rig.run(0.1)
    assert rig.control_loop.tool.grip.origin_rad is not None
    assert "with at most 60 N" in (rig.control_loop.tool.held or "")
    rig.hand = replace(rig.hand, others_requests=1, requested_counts=250)
    if seen_moving:
        standing, force_n = rig.hand, rig.force_n
        rig.hand, rig.force_n = replace(rig.hand, moving=True), 0.0
        rig.run(0.1)
        rig.hand, rig.force_n = standing, force_n
    rig.run(0.1)
    assert not rig.control_loop.tool.grip.known
    assert "has commanded it since then" in rig.control_loop.status.decision.reasons[-1]
    assert "with an unknown force" in (rig.control_loop.tool.held or "")
    rig.control_loop.acknowledge()
    started(rig, GRIP, {"do": "wait", "wait_s": 60})
    rig.run(2)
    assert "with at most 60 N" in (rig.control_loop.tool.held or "")
    assert phase(rig) is ExperimentPhase.RUNNING


def test_a_grip_of_an_earlier_process_that_another_program_changes_is_not_the_present_one():
    """Also where its first states show the fingers in motion, and then on something of the same width."""
    judged: list[str] = []
    loop = new_loop()
    loop.tool.restore_grip(Grip(0.3, 60.0, 30.0, 230), judged.append)
    states = [
        {"holding": False, "moving": True, "requested_counts": 230},
        {"holding": False, "moving": True, "requested_counts": 250, "others_requests": 1},
        {"holding": True, "moving": False, "requested_counts": 250, "others_requests": 1},
    ]
    for number, state in enumerate(states):
        loop.on_gripper(GripperStatus(number, 30.0, **state))
    assert judged == ["another program, or the pendant, has commanded it since then"]
    assert not loop.tool.grip.known


@pytest.mark.parametrize(
    ("sense", "does"),
    [
        ({"moving": True}, "its fingers move, 30.0 mm apart"),
        ({"uncertain": True}, "its fingers stand 30.0 mm apart, and it cannot say whether they hold something"),
        ({"unfelt": True}, "its fingers are 30.0 mm apart with nothing wider between them"),
        ({}, "its fingers are 30.0 mm apart with nothing between them"),
    ],
)
def test_a_grip_that_is_lost_says_what_the_fingers_do(sense, does):
    rig = twisting()
    rig.hand, rig.force_n = replace(rig.hand, **sense), 0.0
    rig.step()
    (fault,) = rig.control_loop.status.decision.reported
    assert fault.cause == f"the gripper no longer holds an object: {does}"


@pytest.mark.parametrize(
    ("sense", "what"),
    [
        ({"uncertain": True}, "stand where a stop, an activation or a lack of power has left them"),
        ({"unfelt": True}, "stand at their target, where a tool of that width is not felt"),
        ({"moving": True}, "are moving"),
    ],
)
@pytest.mark.parametrize("turning", [TWIST, {"do": "turn_to", "angle_rad": 0.4}, {"do": "identify"}])
def test_a_turn_is_refused_while_the_gripper_does_not_know_whether_it_holds_a_tool(sense, what, turning):
    rig = Rig(new_loop())
    for _ in range(70):
        rig.step()
    rig.hand, rig.width_mm = replace(rig.hand, **sense), 43.2
    rig.step()

    def refused(*steps: dict[str, Any], confirmed: bool = False) -> str | None:
        file = ExperimentFile.model_validate({"name": "test", "steps": list(steps)})
        return rig.control_loop.start(file, rig.t_ns, confirmed=confirmed)

    why = refused({"do": "wait", "wait_s": 1}, turning, GRIP)
    assert why == (
        f"the gripper does not know whether it holds a tool: its fingers, 43.2 mm apart, {what}; put a `grip` or a "
        f"`release` before step 2 ({turning['do']}), which turns the wrist"
    )
    assert rig.control_loop.experiment is None
    assert refused({"do": "tare"}, GRIP, turning) is None
    stop(rig)
    rig.control_loop.acknowledge()
    assert refused({"do": "release"}, turning, confirmed=True) is None


def test_an_identification_of_nothing_is_refused():
    rig = Rig(new_loop())
    rig.force_n, rig.width_mm, before_rad = 0.0, 140.0, rig.wrist_rad
    started(rig, {"do": "identify"}, torque_source="load_cell")
    rig.run(1)
    assert "the gripper holds nothing to identify" in rig.control_loop.experiment.stop_reason
    assert rig.wrist_rad == before_rad


def test_a_grip_that_may_meet_nothing_allows_turns_after_it():
    rig = Rig(new_loop())
    rig.hand, rig.force_n = replace(rig.hand, unfelt=True), 0.0
    started(rig, {**GRIP, "expect_object": False}, TWIST_NOW, torque_source="load_cell")
    rig.run(20)
    assert phase(rig) is ExperimentPhase.DONE, rig.control_loop.experiment.stop_reason
    assert "stand at their target" in (rig.control_loop.tool.gripped_tool or "")


def turning_what_is_not_felt(**keys: Any) -> Rig:
    """Return a rig that turns after a grip whose fingers have reached their target: a tool as wide is not felt."""
    rig = Rig(new_loop())
    rig.hand, rig.force_n = replace(rig.hand, unfelt=True), 0.0
    slow = {"do": "twist", "angles_rad": [0.3], "speed_rad_per_s": 0.05}
    started(rig, {**GRIP, "expect_object": False}, slow, torque_source="load_cell", **keys)
    while rig.speed == 0.0:
        rig.step()
    return rig


def test_a_tool_that_is_not_felt_has_an_angle_limit():
    rig = turning_what_is_not_felt(limits={"angle_rad": 0.1})
    rig.run(20)
    assert phase(rig) is ExperimentPhase.STOPPED
    assert rig.control_loop.status.decision.codes == "angle limit"
    assert abs(rig.control_loop.tool.twisted_rad) < 0.12


@pytest.mark.parametrize("silent", ["load_cell", "right"])
def test_a_tool_that_is_not_felt_holds_without_its_torques(silent):
    rig = turning_what_is_not_felt()
    rig.silent.add(silent)
    while rig.speed:
        rig.step()
    assert rig.control_loop.status.decision.codes == "estimate stale"


@pytest.mark.parametrize("sense", [{"uncertain": True}, {"moving": True}])
@pytest.mark.parametrize("turning", [TWIST, {"do": "turn_to", "angle_rad": 0.4}, {"do": "identify"}])
def test_a_gripper_that_becomes_uncertain_after_the_start_fails_the_turn(sense, turning):
    rig = started(Rig(new_loop()), {"do": "wait", "wait_s": 0.1}, turning, GRIP)
    rig.hand = replace(rig.hand, **sense)
    rig.run(1)
    assert not rig.control_loop.experiment.running
    assert (
        f"step 2 ({turning['do']}) cannot be done: the gripper does not know" in rig.control_loop.experiment.stop_reason
    )
    assert rig.control_loop.experiment.stop_reason.endswith("; put a `grip` or a `release` before it")
    assert rig.speed == 0.0


WARM_UP_S = 14.0
TWIST_NOW = {"do": "twist", "angles_rad": [0.1], "hold_s": 0.5}
TIGHTEN = {"do": "tighten", "until_torque_nm": 0.05, "until_angle_rad": 1.0, "direction": "counterclockwise"}


def gripping(*steps: dict[str, Any], warm_up_s: float, **keys: Any) -> Rig:
    """Return a rig whose fingertip measures `warm_up_s` after a grip, and is expected to within WARM_UP_S."""
    sources = {"right": replace(EIT, warm_up_s=WARM_UP_S), "load_cell": LOAD}
    rig = Rig(ControlLoop(CONFIG, sources, ("gripper", "right")))
    rig.warm_up_s = warm_up_s
    return started(rig, GRIP, *steps, **keys)


@pytest.mark.parametrize("drive", ["right", "load_cell"])
@pytest.mark.parametrize("step", [{"do": "identify"}, TWIST_NOW, TIGHTEN], ids=lambda one: one["do"])
def test_a_step_that_turns_the_tool_waits_for_the_first_torque_after_the_grip(step, drive):
    rig = gripping(step, warm_up_s=7.0, torque_source=drive)
    while rig.t_ns < rig.warm_from_s * 1e9 or not rig.warm_from_s:
        rig.step()
        assert rig.speed == 0.0
        assert rig.control_loop.status.phase == "running"
    assert rig.control_loop.status.activity.startswith("waiting for the first torque of right: too recently")
    rig.run(120)
    assert phase(rig) is ExperimentPhase.DONE, rig.control_loop.experiment.stop_reason


def test_a_torque_that_does_not_come_after_the_grip_is_a_fault():
    rig = gripping({"do": "identify"}, warm_up_s=1000.0)
    rig.run(WARM_UP_S + 4)
    assert rig.control_loop.status.phase == "held"
    rig.run(5)
    assert phase(rig) is ExperimentPhase.STOPPED
    assert "right says: too recently" in rig.control_loop.experiment.stop_reason


def test_an_arm_that_a_start_enables_is_no_fault_until_then():
    rig = Rig(new_loop())
    rig.arm = replace(rig.arm, blocked="Motion has not been enabled.", enabled_by_start=True)
    rig.run(1)
    assert rig.control_loop.status.decision.reasons == ()
    file = ExperimentFile.model_validate({"name": "one", "steps": [{"do": "wait", "wait_s": 1}]})
    assert "Motion has not been enabled" in rig.control_loop.start(file, rig.t_ns)


def test_a_run_has_a_number_and_does_not_show_the_end_of_the_one_before():
    rig = Rig(new_loop())
    rig.run(1)
    file = ExperimentFile.model_validate({"name": "one", "steps": [{"do": "wait", "wait_s": 1}]})
    assert loop_state(rig.control_loop, 0.0, rig.t_ns).run == 0
    for run in (1, 2):
        assert rig.control_loop.start(file, rig.t_ns) is None
        begun = loop_state(rig.control_loop, 0.0, rig.t_ns)
        assert (begun.phase, begun.run, begun.progress) == ("running", run, 0.0)
        rig.run(2)
        ended = loop_state(rig.control_loop, 0.0, rig.t_ns)
        assert (ended.phase, ended.run) == ("done", run)


def test_fingers_that_open_are_no_torque_of_a_fingertip():
    rig = gripping({"do": "release"}, warm_up_s=0.0)
    while rig.force_n == 0.0 or rig.control_loop.experiment.step_number < 2:
        rig.step()
    rig.control_loop.on_torque(TorqueSample("right", 0.6, "", rig.t_ns, rig.t_ns))
    rig.step()
    assert phase(rig) is ExperimentPhase.RUNNING
    rig.control_loop.on_torque(TorqueSample("load_cell", 0.6, "", rig.t_ns, rig.t_ns))
    rig.step()
    assert FaultCode.TORQUE_LIMIT in {fault.code for fault in rig.control_loop.status.decision.faults}


def test_a_silent_board_holds_the_wrist_and_then_stops_it():
    rig = twisting()
    assert rig.speed > 0
    rig.silent.add("right")
    rig.run(2.5 * EIT.period_s + 0.7)
    assert (rig.speed, rig.control_loop.status.phase) == (0.0, "held")
    assert rig.control_loop.status.decision.faults[0].code is FaultCode.ESTIMATE_STALE
    rig.run(6)
    assert phase(rig) is ExperimentPhase.STOPPED
    assert rig.orders == End(release=False), "the grip is kept"


def test_a_board_that_speaks_again_in_time_lets_the_twist_go_on():
    rig = started(Rig(new_loop()), GRIP, {"do": "twist", "angles_rad": [0.1], "speed_rad_per_s": 0.02, "hold_s": 1})
    rig.run(4)
    rig.silent.add("right")
    rig.run(3)
    assert rig.control_loop.status.phase == "held"
    rig.silent.clear()
    rig.run(30)
    assert phase(rig) is ExperimentPhase.DONE


def test_the_torque_limit_stops_and_releases_once():
    rig = started(Rig(new_loop(), noise_nm=0.0), GRIP, {"do": "twist", "angles_rad": [1.0]}, limits={"torque_nm": 0.1})
    releases = 0
    for _ in range(2000):
        rig.step()
        releases += rig.orders == End(release=True)
    assert releases == 1
    assert phase(rig) is ExperimentPhase.STOPPED
    assert rig.force_n == 0.0
    assert max(rig.true_nm) < 0.1 + 0.3 * 0.2 * 0.2, "no farther than one reading of the load cell"


def test_a_protective_stop_ends_the_experiment_until_it_is_acknowledged():
    rig = started(Rig(new_loop()), GRIP, {"do": "wait", "wait_s": 60})
    rig.run(2)
    rig.arm = replace(rig.arm, protective_stop=True)
    rig.step()
    assert phase(rig) is ExperimentPhase.STOPPED
    rig.arm = replace(rig.arm, protective_stop=False)
    rig.run(1)
    file = ExperimentFile.model_validate({"name": "again", "steps": [{"do": "wait", "wait_s": 1}]})
    refused = rig.control_loop.start(file, rig.t_ns)
    assert refused is not None
    assert FaultCode.PROTECTIVE_STOP.value.kind in refused
    rig.control_loop.acknowledge()
    assert rig.control_loop.start(file, rig.t_ns) is None


def test_a_stop_after_the_end_has_a_reason_of_its_own():
    rig = started(Rig(new_loop()), {"do": "wait", "wait_s": 60})
    loop = rig.control_loop
    loop.stop(Fault(FaultCode.OPERATOR_STOP, "one"))
    rig.run(0.1)
    assert loop.status.activity == "the operator stopped it: one"
    loop.acknowledge()
    loop.stop(Fault(FaultCode.OPERATOR_STOP, "two"))
    rig.run(0.1)
    assert loop.status.activity == "the operator stopped it: two"
    rig.arm = replace(rig.arm, emergency_stop=True)
    rig.run(0.1)
    assert loop.status.activity == "the operator stopped it: two", "also after another cause has joined"
    rig.arm = replace(rig.arm, emergency_stop=False)
    loop.acknowledge()
    rig.run(0.1)
    assert loop.status.activity.startswith("the stop is acknowledged; its cause was: ")


def test_after_the_acknowledgement_the_state_asks_for_nothing_and_still_names_the_cause():
    rig = started(Rig(new_loop()), GRIP, {"do": "wait", "wait_s": 60})
    rig.run(2)
    rig.arm = replace(rig.arm, protective_stop=True)
    rig.step()
    assert "shearloop command unlock" in rig.control_loop.status.activity
    rig.arm = replace(rig.arm, protective_stop=False)
    rig.control_loop.acknowledge()
    rig.run(1)
    said = rig.control_loop.status.activity
    assert said.startswith("the stop is acknowledged; its cause was: the robot is in a protective stop")
    assert "unlock" not in said


def test_a_stopped_experiment_keeps_its_progress():
    rig = started(Rig(new_loop()), {"do": "wait", "wait_s": 10}, {"do": "wait", "wait_s": 30})
    rig.run(12)
    stop(rig)
    rig.run(1)
    state = loop_state(rig.control_loop, 0.0, rig.t_ns)
    assert state.progress == pytest.approx(0.3, abs=0.01)
    assert state.remaining_s == 0.0


@pytest.mark.parametrize("own_stop", ["protective_stop", "emergency_stop"])
def test_a_stop_of_the_robot_itself_waits_for_the_operator_also_where_nothing_moved(own_stop):
    rig = Rig(new_loop())
    rig.run(1)
    rig.arm = replace(rig.arm, **{own_stop: True})
    rig.step()
    # Somebody has cleared it at the pendant.
    rig.arm = replace(rig.arm, **{own_stop: False})
    rig.run(1)
    file = ExperimentFile.model_validate({"name": "one", "steps": [{"do": "wait", "wait_s": 1}]})
    refused = rig.control_loop.start(file, rig.t_ns)
    assert refused is not None
    assert refused.startswith(f"over by now: {FaultCode[own_stop.upper()].value.kind}")
    assert refused.count("`shearloop command unlock`") == 1
    rig.control_loop.acknowledge()
    rig.step()
    assert rig.control_loop.start(file, rig.t_ns) is None


@pytest.mark.parametrize(
    ("device", "sense", "event"),
    [
        ("arm", {"protective_stop": True}, FaultCode.PROTECTIVE_STOP),
        ("arm", {"emergency_stop": True}, FaultCode.EMERGENCY_STOP),
        ("arm", {"blocked": "the worker was started again"}, FaultCode.ROBOT_BLOCKED),
        ("arm", {"blocked": "the control program does not run", "late": True}, FaultCode.ROBOT_UNCONTROLLED),
        ("hand", {"fault": "the motor is overheated"}, FaultCode.GRIPPER_FAULT),
    ],
)
def test_what_a_device_reports_ends_a_running_experiment_at_once(device, sense, event):
    rig = started(Rig(new_loop()), GRIP, {"do": "twist", "angles_rad": [0.3]})
    rig.run(2)
    setattr(rig, device, replace(getattr(rig, device), **sense))
    rig.step()
    assert isinstance(rig.orders, End)
    assert rig.speed == 0.0
    assert event in {trouble.code for trouble in rig.control_loop.status.decision.faults}


def test_a_supervising_sensor_that_is_gone_holds_the_wrist_at_once_and_says_which():
    rig = twisting()
    rig.control_loop.on_link("load_cell", "/dev/ttyUSB3 was unplugged.", up=False)
    rig.step()
    assert rig.speed == 0.0
    (reason,) = rig.control_loop.status.decision.reasons
    assert "load_cell" in reason
    assert "/dev/ttyUSB3 was unplugged" in reason
    rig.control_loop.on_link("load_cell", "", up=True)
    rig.run(1)
    assert rig.speed > 0.0, "it goes on by itself"


def test_a_task_that_died_stops_the_wrist_and_says_of_what():
    rig = twisting()
    rig.control_loop.inputs.died = {"right": "ValueError: no number"}
    rig.step()
    assert phase(rig) is ExperimentPhase.STOPPED
    assert "right: ValueError: no number" in rig.control_loop.status.decision.reasons[0]


def test_a_single_torque_that_disagrees_holds_until_the_next_one_and_stops_nothing():
    """Of the slower sensor: what it says stands until it says something else."""
    rig = started(Rig(new_loop(), noise_nm=0.0), GRIP, {"do": "twist", "angles_rad": [0.5], "speed_rad_per_s": 0.01})
    rig.run(5)
    while (spiked := rig.control_loop.inputs.torques["right"]).t_ns != rig.t_ns:
        rig.step()
    spike = replace(spiked, torque_nm=spiked.torque_nm + 0.07, t_mid_ns=spiked.t_mid_ns + 1)
    rig.control_loop.on_torque(spike)
    held = 0
    for _ in range(300):
        rig.step()
        assert phase(rig) is ExperimentPhase.RUNNING
        if rig.control_loop.status.decision.response is Response.HOLD:
            held += 1
            assert rig.speed == 0.0
    assert held * TICK_S == pytest.approx(EIT.period_s, abs=2 * TICK_S)
    assert rig.speed > 0.0


def test_a_wrist_angle_that_is_not_a_number_turns_nothing():
    rig = twisting()
    rig.wrist_rad = float("nan")
    rig.sense(0.0)
    assert speed_of(rig.control_loop.tick(rig.t_ns)) == 0.0


def test_no_torque_without_a_zero_turns_a_tool():
    rig = Rig(new_loop(needs_zero=True))
    rig.run(0.6)
    hold, twist = {"do": "hold_torque", "torque_nm": 0.1}, {"do": "twist", "angles_rad": [0.1]}

    def refusal(*steps: dict[str, Any], source: str = "load_cell") -> str:
        file = ExperimentFile.model_validate({"name": "one", "torque_source": source, "steps": list(steps)})
        said = rig.control_loop.start(file, rig.t_ns) or ""
        stop(rig)
        rig.control_loop.acknowledge()
        return said

    for steps in ([GRIP, twist], [GRIP, {"do": "identify"}, hold]):
        assert (
            "no zero of the load_cell is known: none was taken since this daemon began, the last tare failed"
            in refusal(*steps)
        )
        assert "put a `tare` before step 2" in refusal(*steps)
        assert refusal({"do": "tare"}, *steps) == ""
        assert refusal(*steps, source="right") == ""
    assert refusal(GRIP, {"do": "release"}) == ""
    # Before a grip a turn of the empty hand moves no tool; a tool that is held already may be turned by it.
    turn = {"do": "turn_to", "angle_rad": 0.4}
    assert refusal(turn) == ""
    assert "step 2 (turn_to)" in refusal(GRIP, turn)
    rig.hand = replace(rig.hand, uncertain=True)
    rig.run(0.1)
    assert "put a `release` and a `tare` before step 1 (turn_to)" in refusal(turn), "a tare alone would be refused"
    rig.hand, rig.force_n = replace(rig.hand, uncertain=False), 60.0
    rig.run(0.1)
    assert "put a `release` and a `tare` before step 1 (turn_to)" in refusal(turn)
    rig.control_loop.on_zero("load_cell")
    assert refusal(GRIP, twist) == refusal(turn) == ""
    # It may come back with another zero.
    rig.control_loop.on_link("load_cell", "it was unplugged", up=False)
    rig.control_loop.on_link("load_cell", "", up=True)
    assert "no zero of the load_cell" in refusal(twist)


IDENTIFIED = GRIP, {"do": "identify"}


def test_a_hold_counts_from_the_end_of_the_ramp():
    """Within its tolerance of the set point the torque is still on its way there."""
    slow = {"do": "hold_torque", "torque_nm": 0.2, "ramp_nm_per_s": 0.01, "hold_s": 0.0}
    rig = started(Rig(new_loop()), *IDENTIFIED, slow, torque_source="load_cell")
    rig.run(120.0)
    assert phase(rig) is ExperimentPhase.DONE
    assert rig.true_nm[-1] == pytest.approx(0.2, rel=0.03)


def with_a_zero(*steps: dict[str, Any]) -> Rig:
    """Return a rig whose load cell drives these steps, and has its zero."""
    rig = Rig(new_loop(needs_zero=True))
    rig.control_loop.on_zero("load_cell")
    return started(rig, *steps, torque_source="load_cell")


def replug(rig: Rig) -> None:
    rig.control_loop.on_link("load_cell", "it was unplugged", up=False)
    rig.run(0.5)
    rig.control_loop.on_link("load_cell", "", up=True)


TIGHTEN = {"do": "tighten", "direction": "clockwise", "until_torque_nm": 0.2, "until_angle_rad": 0.5}


@pytest.mark.parametrize("paused", [False, True])
@pytest.mark.parametrize(
    ("steps", "at"),
    [
        ((*IDENTIFIED, {"do": "hold_torque", "torque_nm": 0.1, "hold_s": 60}), 3),
        ((GRIP, {"do": "twist", "angles_rad": [0.1], "hold_s": 60}), 2),
        ((GRIP, {"do": "wait", "wait_s": 2}, {"do": "twist", "angles_rad": [0.1]}), 2),
        (({"do": "wait", "wait_s": 2}, GRIP, TIGHTEN), 1),
    ],
)
def test_no_torque_whose_zero_was_lost_in_an_experiment_turns_a_tool_further(steps, at, paused):
    """A board may come back with another zero, and each limit would be off by the difference."""
    rig = with_a_zero(*steps)
    experiment = rig.control_loop.experiment
    while experiment.step_number < at:
        rig.step()
    rig.run(1.5)
    if paused:
        assert rig.control_loop.pause() is None
    before_rad = rig.wrist_rad
    replug(rig)
    rig.run(3.0)
    if paused:
        assert rig.control_loop.resume() is None
    rig.run(10.0)
    assert phase(rig) is ExperimentPhase.STOPPED
    assert FaultCode.ZERO_LOST in {fault.code for fault in rig.control_loop.safety.waiting.faults}
    assert "load_cell" in experiment.stop_reason
    # A step is judged from its second tick on.
    assert rig.wrist_rad == pytest.approx(before_rad, abs=2e-3)


def test_a_zero_that_is_taken_again_lets_the_experiment_go_on():
    rig = with_a_zero({"do": "wait", "wait_s": 2}, {"do": "tare"}, GRIP, {"do": "twist", "angles_rad": [0.1]})
    replug(rig)
    while rig.control_loop.experiment.step_number < 3:
        rig.step()
    rig.control_loop.on_zero("load_cell")
    rig.run(20.0)
    assert phase(rig) is ExperimentPhase.DONE


def test_a_torque_that_has_fallen_silent_is_not_published_as_present():
    rig = holding("load_cell")
    assert rig.control_loop.pause() is None
    assert loop_state(rig.control_loop, 0.0, rig.t_ns).torque_nm == pytest.approx(0.1, abs=0.02)
    rig.silent.add("load_cell")
    rig.run(3)
    assert loop_state(rig.control_loop, 0.0, rig.t_ns).torque_nm is None


def test_a_refused_grip_leaves_an_unknown_grip_unknown():
    rig = Rig(new_loop())
    rig.force_n = 60.0
    rig.run(0.6)
    asked = {**GRIP, "force_n": 20.0}
    started(rig, asked)
    while not rig.begun:
        rig.step()
    rig.pending.clear()
    rig.control_loop.tool.on_grip_refused()
    rig.control_loop.on_action_ended("a grip to 50 mm would open them and drop it")
    rig.run(0.1)
    assert "with an unknown force" in (rig.control_loop.tool.held or "")
    assert FaultCode.GRIP_UNKNOWN in [fault.code for fault in rig.control_loop.status.decision.faults]


def test_a_turn_makes_no_grip_known():
    rig = Rig(new_loop())
    rig.force_n = 60.0
    rig.run(0.6)
    started(rig, {"do": "twist", "angles_rad": [0.05], "hold_s": 0.1}, torque_source="load_cell")
    rig.run(20)
    assert phase(rig) is ExperimentPhase.DONE
    rig.step()
    assert FaultCode.GRIP_UNKNOWN in [fault.code for fault in rig.control_loop.status.decision.faults]


def test_a_grip_that_would_drop_the_held_tool_cannot_be_asked():
    rig = Rig(new_loop())
    rig.force_n, rig.width_mm = 60.0, 30.0
    rig.run(0.6)

    def refusal(*steps: dict[str, Any]) -> str:
        content = {"name": "one", "torque_source": "right", "steps": list(steps)}
        return file_refusal(rig.control_loop.operator, ExperimentFile.model_validate(content)) or ""

    wide = {**GRIP, "width_mm": 35.0}
    assert "step 1 (grip) to 35 mm would open them and drop it: put a `release` before" in refusal(wide)
    # The fingers may stand one count from the width that was asked for.
    assert refusal({**GRIP, "width_mm": 30.5}) == ""
    assert refusal(GRIP) == refusal({"do": "release"}, wide) == refusal(GRIP, {"do": "release"}, wide) == ""
    assert "step 1 (tare): its fingers hold something" in refusal({"do": "tare"}, GRIP)
    assert refusal({"do": "release"}, {"do": "tare"}, GRIP) == ""


def test_a_gripper_that_is_too_hot_says_what_a_release_does_and_grips_nothing():
    rig = Rig(new_loop())
    rig.hand, rig.force_n = replace(rig.hand, too_hot=True), 60.0
    rig.run(0.6)
    assert "it is activated first: the fingers open and close once" in release_question(rig.control_loop.operator)
    file = ExperimentFile.model_validate({"name": "one", "torque_source": "right", "steps": [GRIP]})
    assert "too hot for step 1 (grip): let it cool down" in (file_refusal(rig.control_loop.operator, file) or "")


def test_torques_within_the_noise_of_their_source_are_no_loads():
    """Noise about 0 looked like many short twists to `adapt`, which made a gain of 1.03 one of 0.82."""
    loop = ControlLoop(CONFIG, {"wrench": wrench_source(125.0, noise_nm=0.05), "load_cell": LOAD}, ("robot",))
    torques_nm = [0.2, 0.04, -0.05, 0.03, 0.01, 0.02, -0.06, 0.3]
    for number, torque_nm in enumerate(torques_nm):
        for name in ("wrench", "load_cell"):
            loop.on_torque(TorqueSample(name, torque_nm, "", number, number))
    times_ns, found = loop.torques_of("wrench")
    assert times_ns == list(range(8))
    # The ends of the stretch may be a load that comes or goes.
    np.testing.assert_array_equal(found, [0.2, np.nan, 0.0, 0.0, 0.0, np.nan, -0.06, 0.3])
    assert loop.torques_of("load_cell")[1] == torques_nm
    assert loop.torques_of("other") == ([], [])


@pytest.mark.parametrize(("hold_nm", "is_known"), [(0.0, True), (0.04, False), (-0.045, False)])
def test_a_small_load_within_the_noise_is_not_taken_for_none(hold_nm, is_known):
    """As a true 0 it would teach `adapt` a gain that is too low."""
    noise = np.random.default_rng(2).normal(0.0, 0.003, 100)
    found = beyond_noise(range(100), (hold_nm + noise).clip(-0.05, 0.05).tolist(), 0.05)
    assert bool(np.nanmax(np.abs(found), initial=0.0) == 0.0)
    assert bool(np.isfinite(found).any()) is is_known
