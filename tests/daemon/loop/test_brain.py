from collections import deque
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from daemon.experiment.machine import Phase
from daemon.experiment.steps import ExperimentFile
from daemon.experiment.wishes import Action, GripTo, MoveTo, TakeZero
from daemon.loop.brain import Brain, Orders
from daemon.loop.senses import Arm, Hand, Source, Torque
from daemon.loop.tune import TuneSettings, tuned
from daemon.loop.watch import WatchSettings
from daemon.loop.wrist import Wrist, WristSettings
from daemon.safety import Event, Response
from drivers.emulators.twin import Twin, TwinSettings

TICK_S = 0.008
EIT = Source(name="right", period_s=0.5412, window_s=0.5412)
LOAD = Source(name="load_cell", period_s=1 / 10.9)
GRIP = {"do": "grip", "width_mm": 10.0, "force_n": 60.0}
TUNE = TuneSettings()


def brain(watch: WatchSettings | None = None) -> Brain:
    wrists = {source.name: Wrist(source, WristSettings(), partial(tuned, TUNE)) for source in (EIT, LOAD)}
    return Brain(wrists, watch or WatchSettings(), {"right": EIT, "load_cell": LOAD}, ("gripper", "right"))


class Rig:
    """The twin with sensors and devices around it, stepped in the loop's own ticks: no I/O, no waiting."""

    def __init__(self, subject: Brain, seed: int = 0, noise_nm: float = 0.012) -> None:
        self.brain = subject
        self.twin = Twin(TwinSettings(gel_stiffness_nm_per_rad=0.3))
        self.random = np.random.default_rng(seed)
        self.noise_nm = noise_nm
        self.tick = 0
        self.wrist_rad, self.speed = 0.3, 0.0
        self.force_n, self.width_mm = 0.0, 140.0
        self.window: deque[float] = deque(maxlen=round(EIT.window_s / TICK_S))
        # Whether the fingers meet a tool, expected or not.
        self.meets = False
        self.silent: set[str] = set()
        # What the load cell says too much, and whether it says nothing of use.
        self.offset_nm, self.void = 0.0, False
        self.arm = Arm(0.3, 0)
        self.hand = Hand(0, 140.0, holding=False, moving=False)
        self.pending: list[tuple[int, Action]] = []
        self.begun: list[Action] = []
        self.orders = Orders()
        self.true_nm: list[float] = []

    @property
    def t_ns(self) -> int:
        return round(self.tick * TICK_S * 1e9)

    def step(self) -> None:
        self.tick += 1
        self.wrist_rad += self.speed * TICK_S
        state = self.twin.step(TICK_S, self.wrist_rad, self.force_n)
        self.true_nm.append(state.torque_nm)
        self.window.append(state.shear_torque_nm)
        self._sense(state.torque_nm)
        for due, action in list(self.pending):
            if self.tick >= due:
                self.pending.remove((due, action))
                self._finish(action)
        orders = self.orders = self.brain.tick(self.t_ns)
        self.speed = 0.0 if orders.stop else orders.wrist_rad_per_s
        self.brain.sent(self.speed)
        if orders.release:
            self.force_n = 0.0
        if orders.begin is not None:
            self.begun.append(orders.begin)
            self.pending.append((self.tick + 100, orders.begin))

    def _sense(self, torque_nm: float) -> None:
        now = self.t_ns
        if "arm" not in self.silent:
            self.brain.senses.arm = replace(self.arm, wrist_rad=self.wrist_rad, t_ns=now)
        if "hand" not in self.silent:
            self.brain.senses.hand = replace(self.hand, t_ns=now, holding=self.force_n > 0, width_mm=self.width_mm)
        if self.tick % 68 == 0 and "right" not in self.silent:
            middle = now - round(EIT.window_s * 0.5e9)
            value = float(np.mean(self.window) + self.random.normal(0.0, self.noise_nm))
            self.brain.hear(Torque("right", value, "", middle, now))
        if self.tick % 11 == 0 and "load_cell" not in self.silent:
            value = torque_nm + self.offset_nm + float(self.random.normal(0.0, 0.0005))
            self.brain.hear(Torque("load_cell", None if self.void else value, "", now - 1_000_000, now))

    def _finish(self, action: Action) -> None:
        if isinstance(action, GripTo):
            holds = action.expect_object or self.meets
            self.force_n = action.force_n if holds else 0.0
            self.width_mm = 30.0 if holds else action.width_mm
            # As the gripper's task does, before it says that the fingers have closed.
            self.brain.senses.hand = replace(self.hand, t_ns=self.t_ns, holding=holds, width_mm=self.width_mm)
        self.brain.action_ended()

    def run(self, most_s: float) -> None:
        for _ in range(round(most_s / TICK_S)):
            self.step()
            if self.brain.experiment is not None and not self.brain.experiment.running:
                return


def started(rig: Rig, *steps: dict[str, Any], **keys: Any) -> Rig:
    for _ in range(70):
        rig.step()
    file = ExperimentFile.model_validate({"name": "test", "steps": list(steps), **keys})
    assert rig.brain.start(file, rig.t_ns) is None
    return rig


def phase(rig: Rig) -> Phase:
    assert rig.brain.experiment is not None
    return rig.brain.experiment.phase


@pytest.mark.parametrize("drive", ["right", "load_cell"])
def test_the_loop_grips_identifies_holds_a_torque_and_lets_go(drive: str) -> None:
    rig = started(
        Rig(brain()),
        {"do": "approach", "pose_m_rad": [0.4, 0, 0.3, 0, 3.1, 0]},
        GRIP,
        {"do": "tare"},
        {"do": "identify"},
        {"do": "hold_torque", "torque_nm": 0.1, "hold_s": 20},
        {"do": "release"},
        drive=drive,
    )
    rig.run(200)
    assert rig.brain.experiment is not None
    assert phase(rig) is Phase.DONE, rig.brain.experiment.why
    assert [type(action) for action in rig.begun] == [MoveTo, GripTo, TakeZero, GripTo]
    held = np.array(rig.true_nm)[-round(15 / TICK_S) - 110 : -110]
    assert held.mean() == pytest.approx(0.1, abs=0.008)
    assert held.std() < 0.006


def test_a_set_point_without_identification_is_refused_with_the_cure() -> None:
    rig = started(Rig(brain()), GRIP, {"do": "hold_torque", "torque_nm": 0.1})
    rig.run(20)
    assert phase(rig) is Phase.STOPPED
    assert rig.brain.experiment is not None
    assert "put an `identify` step before" in rig.brain.experiment.why


def test_a_silent_board_holds_the_wrist_and_then_stops_it() -> None:
    rig = started(Rig(brain()), GRIP, {"do": "twist", "angles_rad": [0.5], "speed_rad_per_s": 0.01, "hold_s": 60})
    rig.run(5)
    assert rig.speed > 0
    rig.silent.add("right")
    rig.run(2.5 * EIT.period_s + 0.7)
    assert (rig.speed, rig.brain.standing.phase) == (0.0, "held")
    assert "Look at the sensor's cable" in rig.brain.standing.verdict.reasons[0]
    rig.run(6)
    assert phase(rig) is Phase.STOPPED
    assert rig.orders.stop
    assert not rig.orders.release, "the grip is kept"


def test_a_board_that_speaks_again_in_time_lets_the_twist_go_on() -> None:
    rig = started(Rig(brain()), GRIP, {"do": "twist", "angles_rad": [0.1], "speed_rad_per_s": 0.02, "hold_s": 1})
    rig.run(4)
    rig.silent.add("right")
    rig.run(3)
    assert rig.brain.standing.phase == "held"
    rig.silent.clear()
    rig.run(30)
    assert phase(rig) is Phase.DONE


def test_the_torque_limit_stops_and_releases_once() -> None:
    rig = started(Rig(brain(), noise_nm=0.0), GRIP, {"do": "twist", "angles_rad": [1.0]}, limits={"torque_nm": 0.1})
    releases = 0
    for _ in range(2000):
        rig.step()
        releases += rig.orders.release
    assert releases == 1
    assert phase(rig) is Phase.STOPPED
    assert rig.force_n == 0.0
    assert max(rig.true_nm) < 0.1 + 0.3 * 0.2 * 0.2, "no farther than one reading of the load cell"


def test_a_protective_stop_ends_the_experiment_until_it_is_acknowledged() -> None:
    rig = started(Rig(brain()), GRIP, {"do": "wait", "wait_s": 60})
    rig.run(2)
    rig.arm = replace(rig.arm, protective_stop=True)
    rig.step()
    assert phase(rig) is Phase.STOPPED
    rig.arm = replace(rig.arm, protective_stop=False)
    rig.run(1)
    file = ExperimentFile.model_validate({"name": "again", "steps": [{"do": "wait", "wait_s": 1}]})
    refused = rig.brain.start(file, rig.t_ns)
    assert refused is not None
    assert "protective stop" in refused
    rig.brain.acknowledge()
    assert rig.brain.start(file, rig.t_ns) is None


@pytest.mark.parametrize(
    ("sense", "event"),
    [
        ({"protective_stop": True}, Event.PROTECTIVE_STOP),
        ({"emergency_stop": True}, Event.EMERGENCY_STOP),
        ({"blocked": "the robot's process was started again"}, Event.DEVICE_LOST),
    ],
)
def test_what_the_robot_reports_ends_a_running_experiment_at_once(sense: dict[str, Any], event: Event) -> None:
    rig = started(Rig(brain()), GRIP, {"do": "twist", "angles_rad": [0.3]})
    rig.run(2)
    rig.arm = replace(rig.arm, **sense)
    rig.step()
    assert rig.orders.stop
    assert rig.speed == 0.0
    assert event in {trouble.event for trouble in rig.brain.standing.verdict.troubles}


def test_a_tool_that_is_taken_away_is_noticed() -> None:
    rig = started(Rig(brain()), GRIP, {"do": "twist", "angles_rad": [0.2], "hold_s": 60})
    rig.run(5)
    rig.force_n = 0.0
    rig.step()
    assert Event.GRIP_LOST in {trouble.event for trouble in rig.brain.standing.verdict.troubles}
    assert phase(rig) is Phase.STOPPED


@pytest.mark.parametrize("step", [{**GRIP, "expect_object": False}, {"do": "release", "width_mm": 20}])
def test_a_tool_that_is_met_though_nobody_expected_it_is_watched_as_well(step: dict[str, Any]) -> None:
    rig = Rig(brain())
    rig.meets = True
    started(rig, step, {"do": "twist", "angles_rad": [0.2], "hold_s": 60})
    rig.run(5)
    assert phase(rig) is Phase.RUNNING
    rig.force_n = 0.0
    rig.step()
    assert Event.GRIP_LOST in {trouble.event for trouble in rig.brain.standing.verdict.troubles}
    assert phase(rig) is Phase.STOPPED


def test_a_supervising_sensor_that_is_gone_holds_the_wrist_at_once_and_says_which() -> None:
    rig = started(Rig(brain()), GRIP, {"do": "twist", "angles_rad": [0.5], "speed_rad_per_s": 0.01, "hold_s": 60})
    rig.run(5)
    rig.brain.senses.lost["load_cell"] = "/dev/ttyUSB3 was unplugged."
    rig.step()
    assert rig.speed == 0.0
    assert "load_cell is gone: /dev/ttyUSB3 was unplugged." in rig.brain.standing.verdict.reasons[0]
    rig.brain.senses.lost.clear()
    rig.run(1)
    assert rig.speed > 0.0, "it goes on by itself"


TWIST = {"do": "twist", "angles_rad": [0.2]}


@pytest.mark.parametrize(
    ("sense", "what"),
    [
        ({"unsure": True}, "stand where a stop, an activation or a lack of power has left them"),
        ({"moving": True}, "are moving"),
    ],
)
@pytest.mark.parametrize("turning", [TWIST, {"do": "turn_to", "angle_rad": 0.4}, {"do": "identify"}])
def test_nothing_turns_a_tool_that_the_gripper_may_hold_and_does_not_tell_of(
    sense: dict[str, Any], what: str, turning: dict[str, Any]
) -> None:
    """After a stop in the middle of a grip the wrist turned, and nothing watched torque, angle or grip."""
    rig = Rig(brain())
    for _ in range(70):
        rig.step()
    rig.hand, rig.width_mm = replace(rig.hand, **sense), 43.2
    rig.step()

    def refused(*steps: dict[str, Any]) -> str | None:
        return rig.brain.start(ExperimentFile.model_validate({"name": "test", "steps": list(steps)}), rig.t_ns)

    why = refused({"do": "wait", "wait_s": 1}, turning, GRIP)
    assert why == (
        f"the gripper does not say whether it holds a tool: its fingers, 43.2 mm apart, {what}; put a `grip` or a "
        f"`release` before step 2 ({turning['do']}), which turns the wrist"
    )
    assert rig.brain.experiment is None
    assert refused({"do": "tare"}, GRIP, turning) is None
    rig.brain.stop("")
    assert refused({"do": "release"}, turning) is None


@pytest.mark.parametrize("sense", [{"unsure": True}, {"moving": True}])
@pytest.mark.parametrize("turning", [TWIST, {"do": "turn_to", "angle_rad": 0.4}, {"do": "identify"}])
def test_a_gripper_that_tells_only_after_the_start_that_it_does_not_know_stops_what_turns(
    sense: dict[str, Any], turning: dict[str, Any]
) -> None:
    """It is asked ten times a second: started right after a stop, an experiment was judged by what was before that."""
    rig = started(Rig(brain()), {"do": "wait", "wait_s": 0.1}, turning, GRIP)
    rig.hand = replace(rig.hand, **sense)
    rig.run(1)
    assert rig.brain.experiment is not None
    assert not rig.brain.experiment.running
    assert f"step 2 ({turning['do']}) cannot be done: the gripper does not say" in rig.brain.experiment.why
    assert rig.brain.experiment.why.endswith("; put a `grip` or a `release` before it")
    assert rig.speed == 0.0


def test_a_pause_is_refused_with_the_reason() -> None:
    rig = started(Rig(brain()), {"do": "wait", "wait_s": 60})
    rig.step()
    assert rig.brain.pause() is None
    assert "paused already" in (rig.brain.pause() or "")
    assert rig.brain.resume() is None
    rig.brain.stop("the operator said so")
    assert rig.brain.pause() == "no experiment is running"


def test_a_task_that_died_stops_the_wrist_and_says_of_what() -> None:
    rig = started(Rig(brain()), GRIP, {"do": "twist", "angles_rad": [0.5], "speed_rad_per_s": 0.01, "hold_s": 60})
    rig.run(5)
    rig.brain.senses.died = {"right.estimator": "ValueError: no number"}
    rig.step()
    assert phase(rig) is Phase.STOPPED
    assert "right.estimator: ValueError: no number" in rig.brain.standing.verdict.reasons[0]


FAULTS = st.sampled_from(["right", "load_cell", "arm", "hand", "protective", "pause", "resume", "stop", "kick", "ack"])


@settings(max_examples=40, deadline=None)
@given(st.lists(st.tuples(st.integers(1, 200), FAULTS), max_size=8), st.integers(0, 1000))
def test_no_fault_at_any_time_makes_the_wrist_faster_than_its_limit_or_move_after_a_stop(
    story: list[tuple[int, str]], seed: int
) -> None:
    rig = started(Rig(brain(), seed), GRIP, {"do": "identify"}, {"do": "hold_torque", "torque_nm": 0.08, "hold_s": 5})
    for ticks, fault in [*story, (100, "right")]:
        for _ in range(ticks):
            rig.step()
            assert abs(rig.speed) <= 0.5
            if rig.brain.standing.verdict.response >= Response.HOLD or phase(rig) is not Phase.RUNNING:
                assert rig.speed == 0.0
        match fault:
            case "protective":
                rig.arm = replace(rig.arm, protective_stop=not rig.arm.protective_stop)
            case "pause":
                rig.brain.pause()
            case "resume":
                rig.brain.resume()
            case "stop":
                rig.brain.stop("the operator said so")
            case "ack":
                rig.brain.acknowledge()
            case "kick":
                rig.twin.kick_nm = 0.1 - rig.twin.kick_nm
            case name:
                rig.silent ^= {name}


WRONG = st.sampled_from(["right", "load_cell", "arm", "hand", "void", "late", "apart"])


@settings(max_examples=30, deadline=None)
@given(st.lists(st.tuples(st.lists(WRONG, max_size=2), st.integers(10, 250)), max_size=30), st.integers(0, 1000))
@example([([name], 60) for name in ("void", "apart", "late", "arm") * 6], 0)
def test_whatever_holds_the_wrist_however_it_takes_turns_it_is_stopped_in_time(
    story: list[tuple[list[str], int]], seed: int
) -> None:
    """Held counts whole, free counts half against it: never more than 5 s, and nothing moves while it is held."""
    rig = started(
        Rig(brain(), seed), GRIP, {"do": "twist", "angles_rad": [0.3, -0.3], "speed_rad_per_s": 0.05}, drive="load_cell"
    )
    rig.run(2)
    held_s = 0.0
    for wrong, ticks in story:
        rig.silent = {*wrong} & {"right", "load_cell", "arm", "hand"}
        rig.offset_nm = 0.2 if "apart" in wrong else 0.0
        rig.void = "void" in wrong
        rig.brain.senses.late_s = 0.15 if "late" in wrong else 0.0
        for _ in range(ticks):
            rig.step()
            if phase(rig) is not Phase.RUNNING:
                assert rig.speed == 0.0
                continue
            held = rig.brain.standing.verdict.response is Response.HOLD
            assert not (held and rig.speed)
            assert not held or held_s <= 5.0 + 2 * TICK_S
            held_s = held_s + TICK_S if held else max(0.0, held_s - 0.5 * TICK_S)


def test_a_single_torque_that_disagrees_holds_until_the_next_one_and_stops_nothing() -> None:
    """Of the slower sensor: what it says stands until it says something else."""
    rig = started(Rig(brain(), noise_nm=0.0), GRIP, {"do": "twist", "angles_rad": [0.5], "speed_rad_per_s": 0.01})
    rig.run(5)
    while (spiked := rig.brain.senses.torques["right"]).t_ns != rig.t_ns:
        rig.step()
    assert spiked.torque_nm is not None
    spike = replace(spiked, torque_nm=spiked.torque_nm + 0.07, t_mid_ns=spiked.t_mid_ns + 1)
    rig.brain.hear(spike)
    held = 0
    for _ in range(300):
        rig.step()
        assert phase(rig) is Phase.RUNNING
        if rig.brain.standing.verdict.response is Response.HOLD:
            held += 1
            assert rig.speed == 0.0
    assert held * TICK_S == pytest.approx(EIT.period_s, abs=2 * TICK_S)
    assert rig.speed > 0.0


def test_a_wrist_angle_that_is_not_a_number_turns_nothing() -> None:
    rig = started(Rig(brain()), GRIP, {"do": "twist", "angles_rad": [0.5], "speed_rad_per_s": 0.01, "hold_s": 60})
    rig.run(5)
    assert rig.speed > 0
    rig.wrist_rad = float("nan")
    rig._sense(0.0)
    assert rig.brain.tick(rig.t_ns + 1).wrist_rad_per_s == 0.0
