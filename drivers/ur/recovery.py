"""Makes the robot ready for motion: unlocked, powered, and with the control program running.

No clock: the arm and the time are arguments.
"""

from typing import TYPE_CHECKING

from shearloop.drivers.errors import DriverError
from shearloop.drivers.ur.messages import (
    ROBOT_MODE_IDLE,
    ROBOT_MODE_POWER_OFF,
    ROBOT_MODE_RUNNING,
    RUNTIME_STOPPED,
    SAFETY_NORMAL,
    SAFETY_REDUCED,
    RobotLostError,
    RtdeSample,
)

if TYPE_CHECKING:
    from shearloop.drivers.ur.arm import UrArm

# The period of a request that the robot does not follow yet.
_RETRY_S = 1.0
# A program without heartbeats has ended by its watchdog after this time.
ENDS_ITSELF_S = 2.0
# A program that does not play within this time after its first upload does not start with this worker. A slow
# controller takes seconds, and each upload ends a program that is starting.
STARTS_WITHIN_S, UPLOAD_AGAIN_S = 6.0, 3.0
# An arm that does not come to rest has no load that could be measured for longer than this.
LOAD_WITHIN_S = 5.0

# Messages at the pendant prevent the program from starting.
_CLOSE_POPUPS = ("close popup", "close safety popup")

NOT_STARTING = (
    "The controller took the control program and does not play it: look at the teach pendant for a message, for local "
    "control, and for the log's last lines. The robot's worker is started again with motion disabled."
)
ANOTHERS_PROGRAM = (
    "The program on the robot may be another daemon's: another client writes the robot's input registers. An "
    "unlock would bypass a stop that waits there. End the other daemon, or stop the program at the pendant, then "
    "unlock again."
)
WHOSE_PROGRAM = (
    "{error} So it is not known whether the program on the robot is another daemon's, and nothing is done to it. "
    "Unlock again."
)


class Recovery:
    """One attempt to make the robot ready: unlock, power, brakes, control program, watchdog.

    Each cycle runs one step, and none waits, so that states keep coming while the arm powers up. A protective stop is
    unlocked only on the operator's request (UR's own rule). Without one, only the control program is started.
    """

    def __init__(self, arm: "UrArm", now_ns: int, timeout_s: float, unlock_number: int | None = None) -> None:
        """Begin. The number of an operator's `Unlock` allows unlocking, powering and stopping a program."""
        self.unlock_number = unlock_number
        self._arm = arm
        self._deadline_ns = now_ns + int(timeout_s * 1e9)
        self._timeout_s = timeout_s
        # The deadline begins again with each step of powering up, once.
        self._modes_seen: set[int] = set()
        self._load_by_ns = now_ns + int(LOAD_WITHIN_S * 1e9)
        self._asked_ns: dict[str, int] = {}
        # The requests that the dashboard was sent.
        self._sent: set[str] = set()
        self._cleared = False
        # Since when the program on the robot is left alone.
        self._left_alone_ns: int | None = None
        # When the control program was first sent.
        self._uploaded_ns: int | None = None
        # The controller's latest refusal of a request that could be done without.
        self._answered = ""
        # Whether the attempt has succeeded, or why it has ended otherwise.
        self.ready = False
        self.refusal: str | None = None
        # Whether a tool may load the wrench.
        self.held = False
        # The daemon sees that the zero of the wrench may change, a second before the program starts.
        arm.measure_load_anew()

    @property
    def operator_asked(self) -> bool:
        """Whether the attempt is an operator's."""
        return self.unlock_number is not None

    def give_up(self, reason: str) -> None:
        """End the attempt."""
        self.refusal = reason

    def advance(self, sample: RtdeSample, now_ns: int, *, recent: bool, ours: bool) -> bool:
        """Do the step that is due in this cycle, unless the sample is old; return whether the attempt has ended.

        `ours`: the program that the sample shows is known to be the one that this worker started.

        Raises:
            RobotLostError: the control program cannot be sent, or does not start.
        """
        if sample.robot_mode not in self._modes_seen:
            self._modes_seen.add(sample.robot_mode)
            self._deadline_ns = now_ns + int(self._timeout_s * 1e9)
        if self.refusal is None and now_ns > self._deadline_ns:
            self.refusal = (
                f"The robot did not get ready: it made no step within {self._timeout_s:g} s (robot mode: "
                f"{sample.robot_mode_name}, safety mode: {sample.safety_mode_name}, program: {sample.runtime_name}). "
                f"{self._answered}Look at the teach pendant."
            )
        if sample.runtime_state == RUNTIME_STOPPED:
            self._left_alone_ns = None
        if self.refusal is None and recent:
            self._step(sample, now_ns, ours=ours)
        return self.ready or self.refusal is not None

    def _step(self, sample: RtdeSample, now_ns: int, *, ours: bool) -> None:
        safe = sample.safety_mode in (SAFETY_NORMAL, SAFETY_REDUCED)
        if not (safe and sample.robot_mode == ROBOT_MODE_RUNNING):
            self._make_safe(sample, now_ns, safe=safe, ours=ours)
        elif self._popups_may_be_open:
            self._ask_dashboard(sample, now_ns, *_CLOSE_POPUPS, ours=ours)
        elif self._uploaded_ns is not None and sample.program_running:
            # The control connection may see the program a sample later; then try again in the next cycle.
            self.ready = self._arm.arm_watchdog()
        elif sample.runtime_state != RUNTIME_STOPPED:
            if self.operator_asked:
                self._ask_dashboard(sample, now_ns, "stop", ours=ours)
            else:
                self._leave_alone(sample, now_ns)
        elif not self._cleared:
            # Registers outlive the program: a new one would first execute the last command.
            self._cleared = self._arm.clear_command()
        else:
            if self._uploaded_ns is None and not self._arm.knows_load(held=self.held) and now_ns < self._load_by_ns:
                return
            if self._uploaded_ns is None:
                self._uploaded_ns = now_ns
            elif now_ns >= self._uploaded_ns + int(STARTS_WITHIN_S * 1e9):
                raise RobotLostError("script", NOT_STARTING)
            else:
                # A heartbeat, for a script that arms its watchdog before its loop.
                self._arm.clear_command()
            # The controller may be busy and drop an upload.
            if self._is_due("upload", now_ns, UPLOAD_AGAIN_S):
                self._arm.upload(held=self.held)

    def _make_safe(self, sample: RtdeSample, now_ns: int, *, safe: bool, ours: bool) -> None:
        if not self.operator_asked:
            self.refusal = ""
        elif sample.emergency_stop:
            self.refusal = "The emergency stop is still pressed: make the cell safe, release it, and unlock again."
        elif sample.protective_stop:
            # Once: the controller refuses it in the first 5 s.
            if "unlock protective stop" not in self._sent:
                self._ask_dashboard(sample, now_ns, "unlock protective stop", ours=ours)
        elif not safe:
            self.refusal = (
                f"The safety mode “{sample.safety_mode_name}” cannot be cured from here: look at the pendant."
            )
        elif self._popups_may_be_open:
            self._ask_dashboard(sample, now_ns, *_CLOSE_POPUPS, ours=ours)
        elif sample.robot_mode == ROBOT_MODE_POWER_OFF:
            self._ask_dashboard(sample, now_ns, "power on", ours=ours)
        elif sample.robot_mode == ROBOT_MODE_IDLE:
            self._ask_dashboard(sample, now_ns, "brake release", ours=ours)

    @property
    def _popups_may_be_open(self) -> bool:
        return self.operator_asked and _CLOSE_POPUPS[0] not in self._sent

    def _ask_dashboard(self, sample: RtdeSample, now_ns: int, *requests: str, ours: bool) -> None:
        """Have the dashboard carry out requests, unless the program on the robot may be another client's.

        Another program can begin at any time, so the controller is asked for other clients right before each request.
        A cycle asks the dashboard once, because the answer may take seconds.
        """
        if self._left_alone_ns is not None:
            self._leave_alone(sample, now_ns)
            return
        if not self._is_due(requests[0], now_ns):
            return
        if sample.runtime_state != RUNTIME_STOPPED and not ours:
            try:
                is_anothers = self._arm.has_other_client()
            except RobotLostError as error:
                self.refusal = WHOSE_PROGRAM.format(error=error)
                return
            if is_anothers:
                self._leave_alone(sample, now_ns)
                return
        try:
            refused = self._arm.ask_dashboard(*requests)
        except DriverError as error:
            self.refusal = str(error)
            return
        self._sent.add(requests[0])
        if refused:
            self._answered = f"{refused}. "

    def _leave_alone(self, sample: RtdeSample, now_ns: int) -> None:
        """Wait for the end of a program that may be another client's: its own stop may wait for its operator.

        A program that plays ends by itself, by its watchdog, if its worker has ended. A paused one does not.
        """
        if self._left_alone_ns is None:
            self._left_alone_ns = now_ns
        waited = now_ns > self._left_alone_ns + int(ENDS_ITSELF_S * 1e9)
        if waited or (self.operator_asked and sample.program_paused):
            self.refusal = ANOTHERS_PROGRAM if self.operator_asked else ""

    def _is_due(self, step: str, now_ns: int, period_s: float = _RETRY_S) -> bool:
        """Return whether a step is due, and note that it is taken: the robot may not follow a request at once."""
        due = now_ns >= self._asked_ns.get(step, -(1 << 62)) + int(period_s * 1e9)
        if due:
            self._asked_ns[step] = now_ns
        return due
