"""The whole loop over real ports: the daemon, the real drivers, and the rig played by a process of its own."""

import asyncio
import json
from collections.abc import AsyncIterator, Callable, Mapping
from contextlib import asynccontextmanager
from functools import partial
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from shearloop.bank.bank_file import Bank
from shearloop.daemon.app import Daemon
from shearloop.daemon.config import load_daemon_config
from shearloop.daemon.control.safety import FaultCode
from shearloop.daemon.messaging.client import send_command
from shearloop.daemon.run_summary import RunSummary
from shearloop.drivers.defaults import URCAP_PORT
from shearloop.drivers.robotiq.gripper import RobotiqGripper, WidthCalibration
from shearloop.drivers.robotiq.messages import GripperCommand
from shearloop.drivers.robotiq.socket_client import SocketClient
from shearloop.errors import UserError
from tests.emulator_process import own_address
from tests.fixtures.daemons import ask, robot_at, running_daemon, shearloop
from tests.paper_curve import paper_curve

pytestmark = pytest.mark.real_time

HOST = own_address(4)
SPEED = 8
SLOW_TWIST = {"do": "twist", "angles_rad": [0.1], "speed_rad_per_s": 0.02, "hold_s": 60.0}
BY_ITSELF = {"emulated": True, "autostart": True, "stop_when_done": True}
Write = Callable[..., Path]


def torque_of(sigma: np.ndarray) -> np.ndarray:
    """Where the emulated rig has its sigma at a torque, turned round."""
    return np.asarray((1.85 - sigma) * 0.14 / 0.6)


@pytest.fixture
def rig_config(config, tiny_bank, tmp_path) -> Path:
    """Write the configuration of a whole rig whose boards are SPEED times as fast."""
    sigma = np.linspace(0.95, 2.05, 40)
    calibration = tmp_path / "rig.cal"
    paper_curve(Bank.open(tiny_bank).identity, torque=(sigma, torque_of(sigma))).save(calibration)
    robot_at(HOST, tmp_path)
    # With the deadlines of an emulated rig: the tests of faults have the real ones.
    return config(
        emulated=True,
        right={"calibration": str(calibration), "frame_period_s": 0.5412 / SPEED},
        load_cell={"device": {"path": "load-cell"}, "rate_hz": 10.9 * SPEED},
        robot="ur.yaml",
        gripper={"socket": {"host": HOST}},
        loop={"disagreement_nm": 0.2, "max_innovation_nm": 0.3},
    )


def experiment(folder: Path, *steps: Mapping[str, Any]) -> str:
    path = folder / "experiment.yaml"
    begin = [{"do": "release"}, {"do": "tare"}, {"do": "grip", "width_mm": 5, "force_n": 60}]
    content = {"name": "test", "torque_source": "load_cell", "tool_mm": 20, "steps": [*begin, *map(dict, steps)]}
    path.write_text(yaml.safe_dump(content))
    return str(path)


def ending_with(rig_config: Path, *steps: Mapping[str, Any]) -> Path:
    """Return a configuration whose experiment, of these steps, begins by itself and ends the daemon."""
    path, folder = rig_config.with_name("ending.yaml"), rig_config.parent
    (folder / "own.yaml").write_text(
        yaml.safe_dump({"name": "own", "torque_source": "wrench", "steps": [*map(dict, steps)]})
    )
    content = yaml.safe_load(rig_config.read_text())
    path.write_text(yaml.safe_dump({**content, **BY_ITSELF, "experiment": "own.yaml"}))
    return path


def second_config(rig_config: Path) -> Path:
    """Return the same configuration with sockets of its own."""
    path, folder = rig_config.with_name("second.yaml"), rig_config.parent
    content = yaml.safe_load(rig_config.read_text())
    sockets = {name: f"ipc://{folder}/second-{name}" for name in ("publish", "commands")}
    path.write_text(yaml.safe_dump({**content, **sockets}))
    return path


def spelt_otherwise(config: Path) -> Path:
    """Write another spelling of the robot's address into a configuration."""
    content = yaml.safe_load(config.read_text())
    settings = config.with_name("spelt-otherwise.yaml")
    robot = yaml.safe_load(config.with_name(content["robot"]).read_text())
    first, _, others = robot["host"].partition(".")
    settings.write_text(yaml.safe_dump({**robot, "host": f"{int(first):#x}.{others}"}))
    config.write_text(yaml.safe_dump({**content, "robot": settings.name}))
    return config


class Watcher:
    """Collects what the daemon publishes, and waits for what a test is after."""

    def __init__(self, daemon: Daemon) -> None:
        self.seen: dict[str, list[dict[str, Any]]] = {}
        self._news = asyncio.Event()
        daemon.publisher.add_listener(self._take)

    def _take(self, topic: str, content: dict[str, Any]) -> None:
        self.seen.setdefault(topic, []).append(content)
        self._news.set()

    async def until(self, topic: str, is_so: Callable[[dict[str, Any]], bool]) -> dict[str, Any]:
        checked = 0
        while True:
            for content in self.seen.get(topic, [])[checked:]:
                checked += 1
                if is_so(content):
                    return content
            self._news.clear()
            await self._news.wait()


@asynccontextmanager
async def emulated_rig(folder: Path, bank: Path, speed: int = SPEED) -> AsyncIterator[asyncio.subprocess.Process]:
    async with shearloop(
        *("emulate", "rig", "--bank", str(bank), "--run-dir", str(folder), "--host", HOST),
        *("--speed", str(speed), "--paper-sketch", "--unlock-wait-s", "0.2", "--power-on-s", "0.1"),
        stdin=asyncio.subprocess.PIPE,
    ) as rig:
        assert (await rig.stdout.readline()).startswith(b"rig ready")
        yield rig


async def truth(rig: asyncio.subprocess.Process) -> dict[str, Any]:
    """Return what is really so in the rig now."""
    rig.stdin.write(b"truth\n")
    while "gripped" not in (said := json.loads(await rig.stdout.readline())):
        continue
    return said


@asynccontextmanager
async def running_rig(
    path: Path, bank: Path, speed: int = SPEED
) -> AsyncIterator[tuple[Daemon, Watcher, Callable[[str], None], Callable[..., Any]]]:
    async with emulated_rig(path.parent, bank, speed) as rig, running_daemon(path) as daemon:
        watcher = Watcher(daemon)
        await watcher.until("robot.state", lambda _: True)
        await watcher.until("gripper.state", lambda _: True)
        yield daemon, watcher, lambda line: rig.stdin.write(f"{line}\n".encode()), partial(ask, daemon)


async def started(command: Callable[..., Any], path: str) -> None:
    """Start an experiment as soon as robot and gripper are ready for it: on a busy machine they may be late."""
    reply = await command("start", experiment=path)
    while not reply["ok"] and (
        "being made ready" in reply["reason"] or FaultCode.STATE_STALE.value.kind in reply["reason"]
    ):
        reply = await command("start", experiment=path)
    assert reply["ok"], reply


async def test_a_tool_is_gripped_twisted_released_and_left(rig_config, tiny_bank, tmp_path):
    twist = {"do": "twist", "angles_rad": [0.1], "speed_rad_per_s": 0.3, "hold_s": 1.0}
    leave = {"do": "approach", "along_tool_m": -0.03, "speed_m_per_s": 0.05}
    async with running_rig(rig_config, tiny_bank) as (_, watcher, fault, command):
        fault("robot wrench-error 0")
        seen = len(watcher.seen["robot.state"])
        await started(command, experiment(tmp_path, twist, {"do": "release"}, leave))
        state = await watcher.until("loop.state", lambda state: state["phase"] in ("done", "stopped"))
    assert state["phase"] == "done", state["activity"]
    torques = [message["torque_nm"] for message in watcher.seen["load.torque"]]
    # Gel and joint in series, and what a held gel loses.
    assert max(torques) == pytest.approx(0.1 * 0.8 * 20 / 20.8, rel=0.1)
    assert abs(torques[-1]) < 0.01
    held = [message["diameter_mm"] for message in watcher.seen["gripper.state"] if message["diameter_mm"] is not None]
    assert held[-1] == pytest.approx(20.0, abs=1.0)
    valid = [message["torque_nm"] for message in watcher.seen["eit.estimate"] if message["valid"]]
    assert max(valid) == pytest.approx(max(torques), abs=0.03)
    exact = watcher.seen["robot.state"][seen + 10 :]
    wrench = max(abs(message["wrist_torque_nm"]) for message in exact)
    assert wrench == pytest.approx(max(torques), rel=0.1)
    heights_m = [np.frombuffer(message["tcp_pose"], "<f4")[2] for message in watcher.seen["robot.state"]]
    assert max(heights_m) - heights_m[0] == pytest.approx(0.03, abs=0.005)


async def test_a_protective_stop_ends_the_experiment_and_the_operator_unlocks_it(rig_config, tiny_bank, tmp_path):
    async with running_rig(rig_config, tiny_bank) as (daemon, watcher, fault, command):
        path = experiment(tmp_path, SLOW_TWIST)
        await started(command, path)
        await watcher.until("robot.state", lambda state: state["wrist_speed_rad_per_s"] > 0.01)
        fault("protective-stop")
        state = await watcher.until("loop.state", lambda state: state["phase"] == "stopped")
        assert FaultCode.PROTECTIVE_STOP.text in state["faults"]
        refused = await command("start", experiment=path)
        assert not refused["ok"]
        reply = await command("unlock")
        while not reply["ok"]:
            reply = await command("unlock")
        await started(command, path)
        assert (await command("pause"))["ok"]
        assert (await command("resume"))["ok"]
        turning = watcher.seen["robot.state"][-1]["seq"]
        await watcher.until(
            "robot.state", lambda state: state["seq"] > turning and state["wrist_speed_rad_per_s"] > 0.01
        )
        # As the page's stop: a second one leaves the daemon running.
        assert (await command("stop", spare_daemon=True))["stopped"] == "test"
        last = watcher.seen["robot.state"][-1]["seq"]
        still = await watcher.until(
            "robot.state", lambda state: state["seq"] > last and abs(state["wrist_speed_rad_per_s"]) < 1e-3
        )
        later = await watcher.until("robot.state", lambda state: state["seq"] > still["seq"] + 10)
        assert later["wrist_rad"] == pytest.approx(still["wrist_rad"], abs=1e-3)
        assert (await command("stop", spare_daemon=True))["stopped"] == ""
        await watcher.until("robot.state", lambda state: state["seq"] > later["seq"])
        assert not daemon.supervisor.records["loop"].restarts


async def test_a_daemon_that_is_ended_in_mid_experiment_tells_of_it_as_of_every_end(rig_config, tiny_bank, log):
    out = StringIO()
    path = ending_with(rig_config, {"do": "release"}, {"do": "turn_to", "angle_rad": 3.0, "speed_rad_per_s": 0.2})
    async with running_rig(path, tiny_bank) as (daemon, watcher, _cause, _command):
        daemon.publisher.add_listener(RunSummary(out))
        await watcher.until("robot.state", lambda state: abs(state["wrist_speed_rad_per_s"]) > 0.1)
        daemon.stop()
        await daemon.ending.wait()
    why = "the daemon ended: the wrist is stopped, a gripped tool stays gripped"
    assert not daemon.finished
    assert (watcher.seen["loop.state"][-1]["phase"], watcher.seen["loop.state"][-1]["activity"]) == ("stopped", why)
    assert "stopped as asked" in out.getvalue()
    assert f"  {why}\n" in out.getvalue()
    assert "the experiment has ended" in log.said


async def test_a_daemon_that_ends_with_its_experiment_lets_the_tool_go_first(rig_config, tiny_bank):
    """The stop that opens the gripper ends the experiment, and that the daemon, within the same millisecond."""
    twist = {"do": "twist", "angles_rad": [0.3], "speed_rad_per_s": 0.1, "limits": {"torque_nm": 0.1}}
    grip = {"do": "grip", "width_mm": 5, "force_n": 60}
    path = ending_with(rig_config, {"do": "release"}, {"do": "tare"}, grip, twist)
    async with running_rig(path, tiny_bank) as (daemon, watcher, _cause, _command):
        await daemon.ending.wait()
    assert not daemon.finished
    states = watcher.seen["gripper.state"]
    assert FaultCode.TORQUE_LIMIT.text in watcher.seen["loop.state"][-1]["faults"]
    held_mm = [state["diameter_mm"] for state in states if state["diameter_mm"] is not None][-1]
    assert states[-1]["width_mm"] > held_mm + 5.0


async def test_an_unlock_after_a_fault_of_the_gripper_asks_before_it_drops_the_tool(rig_config, tiny_bank, tmp_path):
    async with running_rig(rig_config, tiny_bank) as (_, watcher, fault, command):
        await started(command, experiment(tmp_path, SLOW_TWIST))
        await watcher.until("robot.state", lambda state: state["wrist_speed_rad_per_s"] > 0.005)
        fault("gripper fault 14")
        await watcher.until("loop.state", lambda state: FaultCode.GRIPPER_FAULT.text in state["faults"])
        held_mm = watcher.seen["gripper.state"][-1]["width_mm"]
        refused = await command("unlock")
        assert "which opens its fingers, and a tool in it drops; its fingers hold something" in refused["reason"]
        assert "with at most 60 N" in refused["question"]
        seen = len(watcher.seen["gripper.state"])
        await watcher.until("gripper.state", lambda _: len(watcher.seen["gripper.state"]) > seen + 5)
        assert watcher.seen["gripper.state"][-1]["width_mm"] == held_mm
        reply = await command("unlock", confirmed=True, digest=refused["digest"])
        while not reply["ok"]:
            reply = await command("unlock", confirmed=True)
        assert watcher.seen["gripper.state"][-1]["width_mm"] > held_mm + 50


async def pendant(*lines: str) -> None:
    """Command the gripper as the robot's own program does, over a connection of its own."""
    reader, writer = await asyncio.open_connection(HOST, URCAP_PORT)
    for line in lines:
        writer.write(f"{line}\n".encode())
        assert await reader.readexactly(3) == b"ack"
    writer.close()
    await writer.wait_closed()


async def test_a_pendant_that_commands_the_gripper_stops_the_twist_and_its_grips_are_seen(
    rig_config, tiny_bank, tmp_path
):
    async with running_rig(rig_config, tiny_bank) as (_, watcher, _fault, command):
        await started(command, experiment(tmp_path, SLOW_TWIST))
        await watcher.until("robot.state", lambda state: state["wrist_speed_rad_per_s"] > 0.005)
        await pendant("SET POS 250")
        state = await watcher.until("loop.state", lambda state: state["phase"] == "stopped")
        assert state["cause"].startswith(FaultCode.GRIPPER_COMMANDED.value.kind)
        assert "nothing between them" not in state["reasons"]
        await watcher.until("loop.state", lambda state: FaultCode.TOOL_GRIPPED.text in state["faults"])
        stop = await watcher.until("loop.stop", lambda _: True)
        # A frame during the motion has no estimate.
        assert stop["faults"].split(", ")[0] == FaultCode.GRIPPER_COMMANDED.text
        reply = await command("release", ask=True)
        while not reply["ok"]:
            reply = await command("release", ask=True)
        question = reply["question"]
        assert "its fingers hold something 19." in question or "its fingers hold something 20." in question
        assert "with an unknown force" in question
        assert (await command("unlock"))["ok"]
        for position, status in ((0, "at target"), (240, "contact closing")):
            last = watcher.seen["gripper.state"][-1]["seq"]
            await pendant(f"SET POS {position}")
            # The state after the request may be from before it.
            moving = await watcher.until(
                "gripper.state", lambda state, last=last: state["seq"] > last and state["object"] == "moving"
            )
            stands = await watcher.until(
                "gripper.state", lambda state, last=moving["seq"]: state["seq"] > last and state["object"] != "moving"
            )
            assert stands["object"] == status
        assert stands["diameter_mm"] == pytest.approx(20.0, abs=1.0)
        assert "its fingers hold something" in (await command("tare", confirmed=True))["reason"]


async def test_a_board_that_is_unplugged_holds_the_wrist(rig_config, tiny_bank, tmp_path):
    async with running_rig(rig_config, tiny_bank) as (_, watcher, fault, command):
        await started(command, experiment(tmp_path, SLOW_TWIST))
        await watcher.until("robot.state", lambda state: state["wrist_speed_rad_per_s"] > 0.005)
        fault("unplug load")
        state = await watcher.until("loop.state", lambda state: FaultCode.SENSOR_LOST.text in state["faults"])
        assert state["phase"] in ("held", "stopped")
        assert state["speed_command_rad_per_s"] == 0.0


async def test_nothing_moves_after_a_restart_a_reconnection_and_an_acknowledgement(
    rig_config, tiny_bank, tmp_path, log
):
    """A tool is gripped, an experiment is configured, the daemon ends in the middle, and nobody asks for a motion."""
    path = experiment(tmp_path, SLOW_TWIST)
    content = {**yaml.safe_load(rig_config.read_text()), "experiment": path}
    rig_config.write_text(yaml.safe_dump(content))
    async with running_rig(rig_config, tiny_bank) as (first, watcher, fault, command):
        await started(command, path)
        await watcher.until("robot.state", lambda state: state["wrist_speed_rad_per_s"] > 0.005)
        first.stop()
        await first.ending.wait()
        # It has the robot to itself until it has ended.
        await log.says_only("stopped")
        async with running_daemon(second_config(rig_config)) as daemon:
            again, ask_again = Watcher(daemon), partial(ask, daemon)
            still = await again.until("robot.state", lambda state: abs(state["wrist_speed_rad_per_s"]) < 1e-3)
            tool = await again.until("gripper.state", lambda state: state["diameter_mm"] is not None)
            state = await again.until("loop.state", lambda state: FaultCode.TOOL_GRIPPED.text in state["faults"])
            assert FaultCode.DAEMON_ENDED.text in state["faults"]
            assert not (await ask_again("start"))["ok"]
            fault("unplug gripper 0.5")
            await again.until("loop.state", lambda state: "gripper" in state["reasons"])
            reply = await ask_again("unlock")
            while not reply["ok"]:
                reply = await ask_again("unlock")
            last = again.seen["robot.state"][-1]["seq"]
            later = await again.until("robot.state", lambda state: state["seq"] > last + 50)
            assert later["wrist_rad"] == pytest.approx(still["wrist_rad"], abs=1e-3)
            assert again.seen["gripper.state"][-1]["width_mm"] == pytest.approx(tool["width_mm"], abs=1.0)
            # Its first frames are of the gripped tool, and no idle frame.
            await again.until("eit.estimate", lambda one: one["reason"].startswith("no idle frame"))
            assert not any(one["valid"] for one in again.seen["eit.estimate"][-10:])
            assert "drops" in (await ask_again("release"))["reason"]
            reply = await ask_again("release", confirmed=True)
            assert reply["ok"], reply
            assert again.seen["gripper.state"][-1]["width_mm"] > tool["width_mm"] + 50


@asynccontextmanager
async def twisting_process(config: Path, rig: asyncio.subprocess.Process) -> AsyncIterator[asyncio.subprocess.Process]:
    """Run the daemon as a process of its own, which twists a gripped tool."""
    address = load_daemon_config(config).commands
    async with shearloop(
        "run", str(config), stdout=asyncio.subprocess.DEVNULL, stderr=asyncio.subprocess.DEVNULL
    ) as own:

        async def command(name: str, **arguments: Any) -> dict[str, Any]:
            try:
                return await asyncio.to_thread(send_command, address, {"command": name, **arguments}, 5.0)
            except (UserError, TimeoutError) as absent:
                return {"ok": False, "reason": str(absent)}

        # The process tells nothing of its start; each request is an answer or a refusal of the connection.
        while not (await command("start", experiment=experiment(config.parent, SLOW_TWIST)))["ok"]:
            pass
        while not ((now := await truth(rig))["gripped"] and abs(now["torque_nm"]) > 0.01):
            continue
        yield own


async def nothing_moves(watcher: Watcher, rig: asyncio.subprocess.Process, before: dict[str, Any]) -> None:
    """Two seconds of the robot's states later wrist and fingers are where they were."""
    last = watcher.seen["robot.state"][-1]["seq"]
    await watcher.until("robot.state", lambda state: state["seq"] > last + 50)
    after = await truth(rig)
    assert after["gripped"]
    assert after["wrist_rad"] == pytest.approx(before["wrist_rad"], abs=1e-4)
    assert after["width_mm"] == before["width_mm"]


async def standing(rig: asyncio.subprocess.Process) -> dict[str, Any]:
    """Return the truth once the wrist stands."""
    before = await truth(rig)
    while (now := await truth(rig))["wrist_rad"] != before["wrist_rad"] or now["time_s"] < before["time_s"] + 0.3:
        before = before if now["wrist_rad"] == before["wrist_rad"] else now
    return now


async def test_after_a_kill_with_a_gripped_tool_nothing_moves_and_start_waits_for_unlock(rig_config, tiny_bank):
    content = {**yaml.safe_load(rig_config.read_text()), "experiment": "experiment.yaml"}
    rig_config.write_text(yaml.safe_dump(content))
    second = spelt_otherwise(second_config(rig_config))
    async with emulated_rig(rig_config.parent, tiny_bank) as rig:
        async with twisting_process(rig_config, rig) as killed:
            async with shearloop("run", str(second)) as refused:
                _, errors = await refused.communicate()
            assert refused.returncode == 2
            assert f"is driven by another program of this computer (process {killed.pid})" in errors.decode()
            killed.kill()
            await killed.wait()
        still = await standing(rig)
        async with running_daemon(second) as daemon:
            watcher, command = Watcher(daemon), partial(ask, daemon)
            await watcher.until("loop.state", lambda state: FaultCode.TOOL_GRIPPED.text in state["faults"])
            await watcher.until("robot.state", lambda _: True)
            await nothing_moves(watcher, rig, still)
            assert "while 'test' was under way" in (await command("start"))["reason"]
            assert (await command("unlock"))["ok"]
            await nothing_moves(watcher, rig, still)


async def exchange_tool(rig: asyncio.subprocess.Process, width_mm: float) -> None:
    """Open the gripper, put another object between its fingers, and close them, as the pendant does."""
    hand = RobotiqGripper(SocketClient(HOST), WidthCalibration.nominal())
    await hand.connect()
    await hand.finish(await hand.move(GripperCommand(140.0)))
    rig.stdin.write(f"gripper object {width_mm}\n".encode())
    state = await hand.finish(await hand.move(GripperCommand(0.0)))
    assert state.diameter_mm == pytest.approx(width_mm, abs=1.0)
    await hand.close()


async def test_a_tool_that_is_exchanged_while_no_daemon_runs_has_no_force_and_no_angle(rig_config, tiny_bank):
    content = {**yaml.safe_load(rig_config.read_text()), "experiment": "experiment.yaml"}
    rig_config.write_text(yaml.safe_dump(content))
    async with emulated_rig(rig_config.parent, tiny_bank) as rig:
        async with twisting_process(rig_config, rig) as killed:
            killed.kill()
            await killed.wait()
        await standing(rig)
        await exchange_tool(rig, 40.0)
        async with running_daemon(rig_config) as daemon:
            watcher = Watcher(daemon)
            state = await watcher.until("loop.state", lambda state: FaultCode.GRIP_UNKNOWN.text in state["faults"])
            assert "mm wide, with an unknown force" in state["reasons"]
            assert daemon.rig.control_loop.tool.grip.origin_rad is None


async def test_a_daemon_of_another_user_that_gets_the_arm_after_a_kill_moves_nothing(
    rig_config, tiny_bank, monkeypatch, tmp_path
):
    """It keeps its memory elsewhere: the robot's registers lock it out until the first one is killed."""
    content = {**yaml.safe_load(rig_config.read_text()), "experiment": "experiment.yaml"}
    rig_config.write_text(yaml.safe_dump(content))
    async with emulated_rig(rig_config.parent, tiny_bank) as rig, twisting_process(rig_config, rig) as killed:
        monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "other"))
        async with running_daemon(second_config(rig_config)) as daemon:
            watcher = Watcher(daemon)
            await watcher.until("gripper.state", lambda _: True)
            killed.kill()
            await killed.wait()
            still = await standing(rig)
            await watcher.until("robot.state", lambda _: True)
            await nothing_moves(watcher, rig, still)
