from pathlib import Path
from types import SimpleNamespace

from shearloop.daemon import rig as rig_module
from shearloop.daemon.clock import Clock
from shearloop.daemon.control.control_loop import ControlLoop
from shearloop.daemon.control.loop_inputs import LoopConfig, TorqueSource
from shearloop.daemon.logs import LinkReporter
from shearloop.daemon.rig import Rig
from shearloop.daemon.supervisor import Supervisor
from shearloop.drivers.connection import LinkEvent
from tests.drivers.ur.flight import SETTINGS


def test_the_control_loop_hears_of_a_lost_device_until_it_returns():
    loop = ControlLoop(LoopConfig(), {"right": TorqueSource(name="right", period_s=0.5)}, ("robot",))
    link = LinkReporter("robot", loop)
    link.on_link_event(LinkEvent(up=False, sentence="the robot's process died", repeated=False))
    assert "the robot's process died" in " ".join(loop_reasons(loop))
    link.on_link_event(LinkEvent(up=True, sentence="it is back", repeated=False))
    assert "the robot's process died" not in " ".join(loop_reasons(loop))


def loop_reasons(loop: ControlLoop) -> tuple[str, ...]:
    loop.tick(0)
    return loop.status.decision.reasons


async def test_a_daemon_that_ends_starts_and_unlocks_nothing(monkeypatch):
    monkeypatch.setattr(rig_module, "robot_settings", lambda _: SETTINGS)
    loop = ControlLoop(LoopConfig(), {"right": TorqueSource(name="right", period_s=0.5)}, ("robot",))
    rig = Rig(SimpleNamespace(robot="ur.yaml"), loop, None, {}, SimpleNamespace(), Clock(), Supervisor())
    path = Path("config/experiments/loosen.yaml")

    async def meanwhile_ends(_: object) -> None:
        rig.close()

    monkeypatch.setattr(rig.runner, "start", meanwhile_ends)
    assert "stopped during its start" in await rig.start(path)
    assert "the daemon ends" in await rig.start(path)
    assert "the daemon ends" in await rig.unlock()
