"""What every stage of a commissioning works with."""

from contextlib import ExitStack
from dataclasses import dataclass, field
from typing import Final

from shearloop.daemon.commissioning import Report
from shearloop.daemon.config import DaemonConfig
from shearloop.drivers.ur.control_box import ControllerInfo
from shearloop.drivers.ur.script import UPPER, ScriptRegisters
from shearloop.drivers.ur.settings import UrSettings
from shearloop.errors import UserError
from shearloop.tools.commission.bounds import bounded
from shearloop.tools.commission.mover import Mover
from shearloop.tools.commission.observer import Observer
from shearloop.tools.commission.operator import Operator

# With fewer stops of each layer a report raises no speed.
STOPS_NEEDED: Final = 5


@dataclass(frozen=True, slots=True)
class Counts:
    """How often and how long a commissioning measures."""

    listen_s: float = 60.0
    uploads_after_s: tuple[float, ...] = (0.0, 5.0, 60.0)
    clock_s: float = 10.0
    rest_s: float = 10.0
    turns: int = 10
    stops: int = STOPS_NEEDED
    speeds_rad_per_s: tuple[float, ...] = (0.05, 0.2, 0.5)
    exchanges: int = 100
    gauges: int = 5
    objects: int = 4
    starts: int = 5
    frames: int = 20
    twists: int = 10


@dataclass(slots=True)
class Context:
    """One commissioning: configuration, settings, operator, report so far, and the two processes on the robot."""

    config: DaemonConfig
    settings: UrSettings
    controller: ControllerInfo
    operator: Operator
    report: Report
    counts: Counts
    opened: ExitStack
    _observer: Observer | None = field(default=None, init=False)
    _mover: Mover | None = field(default=None, init=False)
    # The wrist's angle that the operator confirmed.
    _pose_rad: float | None = field(default=None, init=False)

    @property
    def registers(self) -> ScriptRegisters:
        """The half of the controller's registers that the script uses."""
        return self.controller.registers or UPPER

    @property
    def observer(self) -> Observer:
        """The observer, which is started when it is first needed."""
        if self._observer is None:
            watched = Observer(self.settings.host, self.settings.rate_hz, self.registers)
            self._observer = self.opened.enter_context(watched)
        return self._observer

    @property
    def mover(self) -> Mover:
        """The process that drives the robot, which is started when it is first needed."""
        if self._mover is None:
            here_rad = self.observer.latest().wrist_rad
            self._mover = self.opened.enter_context(Mover(bounded(self.settings, here_rad)))
        return self._mover

    @property
    def pose_rad(self) -> float:
        """The wrist's angle about which motions are allowed; the operator confirms it once."""
        if self._pose_rad is None:
            here_rad = self.observer.latest().wrist_rad
            self.operator.act(
                f"Wrist 3 stands at {here_rad:.3f} rad. Check that the arm stands free, that the tool may turn by "
                "0.1 rad either way and move 20 mm along its axis, and that no cable wraps about the wrist"
            )
            self._pose_rad = here_rad
        return self._pose_rad

    def ready(self) -> Mover:
        """Return the process once the robot is ready to move; raises UserError."""
        if refusal := self.mover.unlock():
            raise UserError(f"the robot does not get ready: {refusal}")
        return self.mover
