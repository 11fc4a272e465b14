"""The whole driver over TCP: ur-rtde in the worker, an emulated controller in another process."""

import asyncio
import contextlib
import os
import re
import signal
import socket
import sys
import time
from collections.abc import AsyncIterator
from pathlib import Path

import pytest

from shearloop.drivers.connection import LinkObserver
from shearloop.drivers.defaults import RTDE_PORT
from shearloop.drivers.ur.client import UrRobot
from shearloop.drivers.ur.control_box import probe_controller, query_controller
from shearloop.drivers.ur.messages import Enable, MoveLinear, RobotLostError, Stop, Unlock, WristSpeed, ZeroForceTorque
from shearloop.drivers.ur.rtde import has_other_client
from shearloop.drivers.ur.script import LOWER, UPPER
from shearloop.drivers.ur.settings import InstalledTool
from tests.drivers.ur.robots import ROOT, enable, pid_of, running, settings_for, until
from tests.emulator_process import EmulatorProcess as ControllerProcess
from tests.emulator_process import Event
from tests.fixtures.daemons import DEADLINE_S

pytestmark = pytest.mark.real_time

pytest.importorskip("rtde_control", reason="ur-rtde has wheels for CPython up to 3.12 on x86-64 only")

# A twist whose client dies: its deadline in these tests, and the time to brake.
STOPPED_WITHIN_S = settings_for("192.168.1.10").standstill_s
# The timer of a connection in /proc/net/tcp.
KEPT_ALIVE = "02"


def timers_of(pid: int, host: str, port: int) -> list[str]:
    """Return the timer of each connection of a process to a port of a host (proc(5), /proc/net/tcp)."""
    address = f"{int.from_bytes(socket.inet_aton(host), sys.byteorder):08X}:{port:04X}"
    inodes = {os.readlink(path) for path in Path(f"/proc/{pid}/fd").iterdir() if path.exists()}
    rows = [line.split() for line in Path("/proc/net/tcp").read_text().splitlines()[1:]]
    return [row[5].partition(":")[0] for row in rows if row[2] == address and f"socket:[{row[9]}]" in inodes]


async def turn(robot: UrRobot, controller: ControllerProcess, speed: float = 0.5) -> None:
    """Turn the wrist and return when it has reached its speed; on a busy computer the first command may end before."""
    since_ns = time.monotonic_ns()
    async with asyncio.timeout(DEADLINE_S):
        while True:
            reply = await robot.send(WristSpeed(speed, 4.0))
            assert reply.accepted, reply.refusal
            state = await robot.next_state()
            if abs(state.qd_rad_per_s[5]) > 0.9 * abs(speed):
                break
    await controller.event("motion-started", since_ns)


@contextlib.asynccontextmanager
async def turning(
    controller: ControllerProcess, link: LinkObserver | None = None, **changes: float
) -> AsyncIterator[UrRobot]:
    """Return a robot with a turning wrist."""
    async with running(settings_for(controller.host, **changes), link) as robot:
        await enable(robot)
        await turn(robot, controller)
        yield robot


async def stops(controller: ControllerProcess, since_ns: int, within_s: float = STOPPED_WITHIN_S) -> Event:
    """Wait until the motion has stopped, and return when; it has to be in time."""
    stopped = await controller.event("motion-stopped", since_ns)
    assert (stopped["t_mono_ns"] - since_ns) / 1e9 <= within_s
    return stopped


async def test_every_connection_of_the_worker_ends_when_the_controller_has_vanished(controller):
    """Ours is kept alive, and so is that of ur-rtde."""
    async with running(settings_for(controller.host)) as robot, asyncio.timeout(DEADLINE_S):
        await until(robot, lambda state: state.program_running and not state.recovering)
        # Another timer runs while something that was sent is not acknowledged.
        while timers_of(pid_of(robot), controller.host, RTDE_PORT) != [KEPT_ALIVE] * 2:
            await robot.next_state()


async def test_states_arrive_and_replies_hold_the_sent_command(controller):
    async with running(settings_for(controller.host)) as robot:
        assert "not connected" in (await robot.send(Enable())).refusal
        await until(robot, lambda state: state.program_running and not state.recovering)
        assert "not been enabled" in (await robot.send(WristSpeed(0.1, 1.0))).refusal
        await enable(robot)

        reply = await robot.send(WristSpeed(3.0, 9.0))
        assert reply.sent == WristSpeed(0.5, 4.0)
        assert reply.clipped == ("acceleration is limited to 4", "wrist speed is limited to 0.5 rad/s")
        state = await until(robot, lambda state: state.qd_rad_per_s[5] > 0.49)
        assert state.sent == reply.sent
        assert not state.blocked
        assert state.age_ns < 100_000_000
        assert 0 <= time.monotonic_ns() - state.read_ns < 500_000_000

        assert (await robot.send(Stop(4.0))).sent == Stop(4.0)
        state = await until(robot, lambda state: state.motion == "idle")
        assert state.end_reason == "stopped on command"
        assert (await robot.send(ZeroForceTorque())).accepted

        x, y, z, *turned = state.tcp_pose
        target = (x, y, z - 0.02, turned[0], turned[1], turned[2])
        reply = await robot.send(MoveLinear(target, 0.1, 0.5))
        assert reply.sent == MoveLinear(target, 0.1, 0.5)
        number = (await until(robot, lambda state: state.motion == "linear")).motion_id
        state = await until(robot, lambda state: state.motion == "idle")
        assert (state.motion_id, state.end_reason) == (number, "arrived")
        assert state.tcp_pose[2] == pytest.approx(z - 0.02, abs=1e-5)


async def test_linear_move_is_stopped_and_repeated(controller):
    async with running(settings_for(controller.host)) as robot:
        await enable(robot)
        x, y, z, *turned = (await robot.next_state()).tcp_pose
        move = MoveLinear((x, y, z + 0.04, turned[0], turned[1], turned[2]), 0.05, 0.5)
        assert (await robot.send(move)).accepted
        await until(robot, lambda state: state.tcp_pose[2] > z + 0.01)
        assert (await robot.send(Stop(4.0))).sent == Stop(4.0)
        state = await until(robot, lambda state: state.motion == "idle")
        assert (state.end_reason, state.blocked) == ("stopped on command", "")
        assert state.tcp_pose[2] < z + 0.03
        assert (await robot.send(move)).accepted
        await until(robot, lambda state: state.motion == "idle" and state.end_reason == "arrived")
        assert (await robot.next_state()).tcp_pose[2] == pytest.approx(z + 0.04, abs=1e-4)


async def test_state_comes_125_times_a_second_with_the_controllers_own_time(controller):
    async with running(settings_for(controller.host)) as robot:
        first = await until(robot, lambda state: not state.recovering)
        states = [await robot.next_state() for _ in range(100)]
        own_s = states[-1].timestamp_s - first.timestamp_s
        ours_s = (states[-1].read_ns - first.read_ns) / 1e9
        # Both clocks tell the same, but for cycles that a busy machine made late.
        assert own_s == pytest.approx(ours_s, abs=0.3)
        assert sorted(states, key=lambda state: state.timestamp_s) == states


@pytest.mark.parametrize(
    ("cause", "kinds", "said"),
    [
        (signal.SIGSEGV, {"crashed"}, "SIGSEGV.*motion disabled"),
        (signal.SIGSTOP, {"hung"}, "did not answer.*motion disabled"),
        # What comes first is up to the client: our look at its connection, or its crash or hang in reconnecting.
        ("drop-rtde", {"lost", "crashed", "hung"}, ""),
    ],
    ids=["killed", "hung", "lost"],
)
async def test_twist_stops_with_its_worker_and_the_next_worker_moves_nothing(controller, link, cause, kinds, said):
    async with turning(controller, link, hang_timeout_s=0.3) as robot:
        since_ns = time.monotonic_ns()
        if isinstance(cause, str):
            await controller.fault(cause)
        else:
            os.kill(pid_of(robot), cause)
        stopped = await stops(controller, since_ns)
        unanswered = robot.send(Stop(1.0)) if cause is signal.SIGSTOP else None
        assert re.search(said, (await link.down()).sentence)
        assert robot.losses.keys() <= kinds
        assert unanswered is None or (await unanswered).refusal.endswith("motion disabled. Nothing is sent again.")

        state = await until(robot, lambda state: state.program_running and not state.recovering)
        assert "not been enabled" in state.blocked
        assert "not been enabled" in (await robot.send(WristSpeed(0.1, 1.0))).refusal
        await controller.event("watchdog-armed", stopped["t_mono_ns"])
        assert not controller.happened("motion-started", since_ns), "a second motion"
        await enable(robot)
        await turn(robot, controller)


async def test_stalled_samples_end_the_motion(controller):
    """Longer than `state_timeout_s`, shorter than the watchdog's time: the wrist must not turn on."""
    async with turning(controller) as robot:
        stalled_ns = await controller.fault(f"silence {robot.settings.state_timeout_s + 0.04}")
        # Wanted until the data are no longer believed.
        assert (await robot.send(WristSpeed(0.5, 4.0))).accepted
        await stops(controller, stalled_ns, robot.settings.state_timeout_s + STOPPED_WITHIN_S)
        state = await until(robot, lambda state: state.age_ns < 100_000_000)
        assert state.blocked
        assert (await robot.send(Unlock())).accepted
        assert not controller.happened("motion-started", stalled_ns)
        await turn(robot, controller)


async def test_protective_stop_is_reported_and_unlocked_by_the_same_worker(controller):
    async with turning(controller) as robot:
        pid = pid_of(robot)
        asked_ns = await controller.fault("protective-stop")
        state = await until(robot, lambda state: state.protective_stop)
        assert "Protective stop" in state.blocked
        assert "Protective stop" in (await robot.send(WristSpeed(0.1, 1.0))).refusal
        assert "Cannot unlock" in (await robot.send(Unlock())).refusal
        # The controller's own second has to pass.
        await until(robot, lambda later: later.timestamp_s > state.timestamp_s + 1.0)
        assert (await robot.send(Unlock())).accepted
        await controller.event("watchdog-armed", asked_ns)
        assert not controller.happened("motion-started", asked_ns), "the speed from before the stop was taken up again"
        await turn(robot, controller, -0.5)
        assert pid_of(robot) == pid


async def test_program_starts_again_long_after_the_first_upload(controller):
    """The controller streams to ur-rtde's own script connection, which is never read, until it listens no longer."""
    async with running(settings_for(controller.host)) as robot:
        await enable(robot)
        pid, first = pid_of(robot), await robot.next_state()
        await until(robot, lambda state: state.timestamp_s > first.timestamp_s + 4.0)
        await controller.fault("normal")  # ends the program
        await until(robot, lambda state: not state.program_running)
        assert (await robot.send(Unlock())).accepted
        assert pid_of(robot) == pid


async def test_worker_whose_scripts_are_dropped_is_replaced_until_one_starts(controller, link):
    await controller.fault("drop-scripts")
    async with running(settings_for(controller.host), link) as robot:
        assert "does not play it" in (await link.down()).sentence
        assert robot.losses["script"] == 1
        await controller.fault("normal")
        await enable(robot)


async def test_emergency_stop_is_reported_and_recovered_from(controller):
    async with turning(controller) as robot:
        asked_ns = await controller.fault("emergency-stop")
        state = await until(robot, lambda state: state.emergency_stop)
        assert "Emergency stop" in state.blocked
        assert "still pressed" in (await robot.send(Unlock())).refusal
        await controller.fault("release")
        await until(robot, lambda state: not state.emergency_stop)
        assert (await robot.send(Unlock())).accepted
        assert not controller.happened("motion-started", asked_ns)
        await turn(robot, controller)


async def test_silent_controller_is_reported_and_the_robot_stops(controller, link):
    async with turning(controller, link, connect_timeout_s=1.5) as robot:
        silent_ns = await controller.fault("silence 3600")
        # Data is believed for state_timeout_s, then the watchdog is no longer kicked.
        await stops(controller, silent_ns, robot.settings.state_timeout_s + STOPPED_WITHIN_S)
        assert "old: check its cable" in (await link.down(1)).sentence
        loss = await link.down(2)
        assert robot.losses["silent"] == 1
        assert f"The UR controller at {controller.host} said nothing" in loss.sentence
        await controller.fault("normal")
        await enable(robot)
        assert not controller.happened("motion-started", silent_ns)


@pytest.mark.parametrize(
    ("fault", "kind", "said"),
    [
        ("registers-in-use", "registers-in-use", "EtherNet/IP or PROFINET"),
        ("local-control", "local-control", "switch it to remote control"),
        ("refuse-protocol", "protocol", "refuses version 2 of the RTDE protocol"),
        ("mute-dashboard", "silent", "while asking its dashboard server (port 29999): it is starting, hangs"),
    ],
)
async def test_connection_that_is_refused_is_explained(controller, link, fault, kind, said):
    await controller.fault(fault)
    async with running(settings_for(controller.host), link) as robot:
        loss = await link.down()
        assert robot.losses[kind] == 1
        assert said in loss.sentence
        assert said in (await robot.send(Enable())).refusal


async def test_registers_of_the_upper_half_that_another_client_writes_are_left_to_it(controller):
    host = controller.host
    assert query_controller(host, 5.0).registers == UPPER
    assert not has_other_client(host, 5.0, LOWER)
    await controller.fault("upper-registers-in-use")
    assert query_controller(host, 5.0).registers == LOWER
    assert has_other_client(host, 5.0, LOWER)
    assert not has_other_client(host, 5.0, UPPER)
    async with running(settings_for(host)) as robot:
        await enable(robot)
        await turn(robot, controller, 0.1)


async def test_an_unlock_beside_another_daemon_leaves_its_program_alone(controller):
    """The second one takes the other half of the registers, and does not know the first one's stop."""
    settings = settings_for(controller.host)
    async with running(settings) as first:
        await enable(first)
        await controller.fault("protective-stop")
        await until(first, lambda state: state.protective_stop and state.program_paused)
        async with running(settings) as second:
            await until(second, lambda state: not state.recovering)
            assert "may be another daemon's" in (await second.send(Unlock())).refusal
            assert (await second.next_state()).program_paused


async def test_error_codes_of_the_controller_are_reported(controller, link):
    async with running(settings_for(controller.host), link) as robot:
        await enable(robot)
        await controller.fault("protective-stop")
        assert "C204A3 (violation)" in await link.refusal()


async def test_unsupported_controller_does_not_restart_the_worker(controller, link):
    for version in ("5.0.0.0", "3.9.1.0", "10.7.0.0", "5.3.9.0"):
        await controller.fault(f"version {version}")
        with pytest.raises(RobotLostError, match=f"has PolyScope {version}, which cannot be driven"):
            await asyncio.to_thread(probe_controller, controller.host, 5.0)
    async with running(settings_for(controller.host), link) as robot:
        await link.down()
        # The first pause of other losses is 0.2 s.
        with pytest.raises(TimeoutError):
            async with asyncio.timeout(1.0):
                await link.down(2)
        assert robot.losses == {"version": 1}


async def test_a_new_controller_is_driven_by_the_half_of_the_registers_that_ur_rtde_takes_there(controller):
    """From 5.23 on, ur-rtde 1.6.5 takes the lower half, whatever it is asked for."""
    await controller.fault("version 5.23.0.0")
    info = await asyncio.to_thread(query_controller, controller.host, 3.0)
    assert info.registers == LOWER
    async with running(settings_for(controller.host)) as robot:
        await enable(robot)
        await turn(robot, controller)


async def test_controller_that_is_newer_than_the_tested_ones_is_driven_with_a_warning(controller, link):
    await controller.fault("version 5.18.0.0")
    async with running(settings_for(controller.host), link) as robot:
        await enable(robot)
        assert "PolyScope 5.18.0.0 is newer than 5.17.3" in robot.monitor.latest.sentence


async def test_another_payload_than_the_configured_one_refuses_motion(controller):
    async with running(
        settings_for(controller.host, tool=InstalledTool(payload_kg=1.0, tcp_offset=(0.0,) * 6))
    ) as robot:
        await enable(robot)
        await controller.fault("payload 1.4")
        state = await until(robot, lambda state: state.payload_kg == 1.4)
        assert "The controller has payload_kg 1.4, the robot's settings have 1:" in state.blocked
        assert "payload_kg" in (await robot.send(Enable())).refusal
        await controller.fault("payload 1.0")
        await until(robot, lambda state: state.payload_kg == 1.0)
        assert (await robot.send(Enable())).accepted


@pytest.mark.parametrize(
    ("fault", "named"),
    [("slider", "speed slider is at 50 %"), ("scaling", "controller slows every motion to 50 % by itself")],
)
async def test_what_slows_the_wrist_stops_it_and_is_named(controller, fault, named):
    """The pendant's slider, and the controller's own limits: the motion has the product of both."""
    async with turning(controller) as robot:
        slowed_ns = await controller.fault(f"{fault} 0.5")
        await stops(controller, slowed_ns)
        state = await until(robot, lambda state: state.motion == "idle")
        assert state.speed_scaling == 0.5
        assert named in (await robot.send(Enable())).refusal
        await controller.fault(f"{fault} 1")
        await until(robot, lambda state: state.speed_scaling == 1.0)
        assert (await robot.send(Enable())).accepted


async def test_leaving_stops_the_arm_and_ends_the_program(controller):
    """Also when a terminal or service manager signals every process."""
    async with turning(controller) as robot:
        left_ns = time.monotonic_ns()
        for told in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            os.kill(pid_of(robot), told)
    assert not robot.diagnostics()["connected"], "the worker's last states count as a connection"
    stopped = await controller.event("motion-stopped", left_ns)
    ended = await controller.event("program-ended", left_ns)
    assert ended["t_mono_ns"] >= stopped["t_mono_ns"]
    assert ended["detail"] == "it has run to its end"


DAEMON = """
import asyncio, sys
from shearloop.drivers.ur.client import UrRobot
from shearloop.drivers.ur.messages import Enable, WristSpeed
from tests.drivers.ur.robots import pid_of, settings_for, until

async def main():
    robot = UrRobot(settings_for(sys.argv[1], command_timeout_s=0.1, silence_timeout_s=0.1))
    task = asyncio.create_task(robot.run())
    await until(robot, lambda state: state.program_running and not state.recovering)
    await robot.send(Enable())
    while True:
        await robot.send(WristSpeed(0.5, 4.0))
        state = await robot.next_state()
        if state.qd_rad_per_s[5] > 0.49:
            print(pid_of(robot), flush=True)

asyncio.run(main())
"""


@contextlib.asynccontextmanager
async def turning_daemon(controller: ControllerProcess) -> AsyncIterator[tuple[asyncio.subprocess.Process, int]]:
    """Yield a daemon's process, whose robot turns, and its worker's id; both are killed at the end."""
    daemon = await asyncio.create_subprocess_exec(
        sys.executable, "-c", DAEMON, controller.host, stdout=asyncio.subprocess.PIPE, cwd=ROOT
    )
    worker = int(await daemon.stdout.readline())
    try:
        yield daemon, worker
    finally:
        for pid in (daemon.pid, worker):
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        await daemon.communicate()


@pytest.mark.parametrize("worker_hangs", [False, True])
async def test_wrist_stops_when_the_daemon_hangs(controller, worker_hangs):
    async with turning_daemon(controller) as (daemon, worker):
        hung_ns = time.monotonic_ns()
        daemon.send_signal(signal.SIGSTOP)
        if worker_hangs:
            os.kill(worker, signal.SIGSTOP)
        await stops(controller, hung_ns)


async def test_killed_daemon_leaves_a_resting_robot_and_no_process(controller):
    async with turning_daemon(controller) as (daemon, pid):
        worker, ended, killed_ns = os.pidfd_open(pid), asyncio.Event(), time.monotonic_ns()
        daemon.kill()
        await stops(controller, killed_ns)
        asyncio.get_running_loop().add_reader(worker, ended.set)
        async with asyncio.timeout(5):
            await ended.wait()
        asyncio.get_running_loop().remove_reader(worker)
        os.close(worker)
        assert (await controller.event("program-ended", killed_ns))["detail"] == "it has run to its end"
