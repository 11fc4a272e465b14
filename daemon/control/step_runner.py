"""Carries an experiment through its steps: start, pause, hold, resume, stop, done. No I/O; the time is passed in."""

from dataclasses import dataclass, replace
from enum import Enum

from shearloop.daemon.control.experiment_schema import ExperimentFile, ExperimentLimits, Step
from shearloop.daemon.control.programme import Programme, StepFailedError, expected_s, programme_of
from shearloop.daemon.control.step_commands import Hold, StepCommand, StepContext


class ExperimentPhase(Enum):
    """Where an experiment stands."""

    RUNNING = "running"
    PAUSED = "paused"  # by the operator
    DONE = "done"
    STOPPED = "stopped"  # before its end, by the operator, by safety, or by a step that failed


@dataclass(frozen=True, slots=True)
class Progress:
    """What an operator is shown."""

    phase: ExperimentPhase
    step: int
    steps: int
    doing: str
    share: float
    remaining_s: float
    overdue: str = ""


class Experiment:
    """One run of an experiment file."""

    def __init__(self, file: ExperimentFile, t_ns: int) -> None:
        self.file = file
        self._expected_s = [expected_s(step) for step in file.steps]
        self.phase = ExperimentPhase.RUNNING
        self.why = ""
        self._t_ns = t_ns
        self._elapsed_s = 0.0
        self._index = -1
        self._step_began_s = 0.0
        self._wish = StepCommand()
        self._programme: Programme
        self._begin_next()

    @property
    def running(self) -> bool:
        """Whether it may still move something."""
        return self.phase in (ExperimentPhase.RUNNING, ExperimentPhase.PAUSED)

    @property
    def step(self) -> Step:
        """The step that is being carried out, or the last one."""
        return self.file.steps[min(self._index, len(self.file.steps) - 1)]

    @property
    def limits(self) -> ExperimentLimits:
        """The tighter of the experiment's limits and the step's own."""
        own, whole = self.step.limits, self.file.limits
        if own is None:
            return whole
        return ExperimentLimits(
            torque_nm=min(own.torque_nm, whole.torque_nm), angle_rad=min(own.angle_rad, whole.angle_rad)
        )

    @property
    def number(self) -> int:
        """The number of that step, counted from one."""
        return min(self._index + 1, len(self.file.steps))

    @property
    def doing(self) -> str:
        """What is being done, or why nothing is any more."""
        return self._wish.doing if self.running else self.why

    @property
    def overdue(self) -> str:
        """Which step has taken longer than it may, or the empty string."""
        longest_s = self.step.timeout_s
        if not self.running or longest_s is None or self._spent_s <= longest_s:
            return ""
        return f"step {self._index + 1} ({self.step.do}) has taken {self._spent_s:.1f} s of at most {longest_s:g} s"

    @property
    def _spent_s(self) -> float:
        return self._elapsed_s - self._step_began_s

    @property
    def wish(self) -> StepCommand:
        """What is wished for, whether or not it is held back at present."""
        return self._wish

    def update(self, view: StepContext, t_ns: int, *, held: bool = False) -> StepCommand:
        """Return what is wished for now; while paused or held the wrist stands and no time passes."""
        passed_s = max(0, t_ns - self._t_ns) / 1e9
        self._t_ns = max(t_ns, self._t_ns)
        if not self.running:
            return StepCommand()
        if self.phase is ExperimentPhase.PAUSED or held:
            return replace(self._wish, wrist=Hold())
        self._elapsed_s += passed_s
        try:
            self._wish = self._numbered(self._programme.send(view))
        except StopIteration:
            self._begin_next()
        except StepFailedError as failure:
            self.stop(f"step {self._index + 1} ({self.step.do}) failed: {failure}")
        return self._wish

    def pause(self) -> None:
        """Stand still until `resume`."""
        if self.phase is ExperimentPhase.RUNNING:
            self.phase = ExperimentPhase.PAUSED

    def resume(self) -> None:
        """Go on where it was paused."""
        if self.phase is ExperimentPhase.PAUSED:
            self.phase = ExperimentPhase.RUNNING

    def stop(self, why: str) -> None:
        """End for good; a stopped experiment is started anew, never resumed."""
        if self.running:
            self.phase, self.why, self._wish = ExperimentPhase.STOPPED, why, StepCommand()

    def progress(self) -> Progress:
        """Return where it stands."""
        ahead_s = sum(self._expected_s[self._index + 1 :])
        planned_s = sum(self._expected_s)
        here_s = max(0.0, self._expected_s[self.number - 1] - self._spent_s)
        remaining_s = here_s + ahead_s if self.running else 0.0
        return Progress(
            phase=self.phase,
            step=self.number,
            steps=len(self.file.steps),
            doing=self.doing,
            share=1.0 if self.phase is ExperimentPhase.DONE else max(0.0, 1.0 - remaining_s / max(planned_s, 1e-9)),
            remaining_s=remaining_s,
            overdue=self.overdue,
        )

    def _numbered(self, wish: StepCommand) -> StepCommand:
        # In every cycle of the robot: `replace` would look the fields up each time.
        return StepCommand(wish.wrist, wish.action, wish.doing, self._index, wish.hold)

    def _begin_next(self) -> None:
        while self._index + 1 < len(self.file.steps):
            self._index += 1
            self._step_began_s = self._elapsed_s
            self._programme = programme_of(self.step, lambda: self._elapsed_s)
            try:
                self._wish = self._numbered(next(self._programme))
            except StopIteration:  # nothing to do, such as a wait of 0 s
                continue
            return
        self._index = len(self.file.steps)
        self.phase, self._wish = ExperimentPhase.DONE, StepCommand()
