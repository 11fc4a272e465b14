from shearloop.daemon.control.control_loop import ControlLoop
from shearloop.daemon.control.loop_inputs import LoopConfig, TorqueSource
from shearloop.daemon.logs import LinkReporter
from shearloop.drivers.connection import LinkEvent


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
