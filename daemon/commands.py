"""The daemon's commands: one handler each, which executes the command or refuses it with a reason."""

import asyncio
import os
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

from shearloop.daemon.errors import InvalidExperimentError
from shearloop.daemon.messaging.command_server import (
    EXPERIMENTS,
    STATUS,
    STOP,
    CommandRefusedError,
    Handler,
    Reply,
    Request,
)
from shearloop.daemon.messaging.deadlines import MAY_BE_UNBOUND, NEVER_LATE, Deadline, boot_ns
from shearloop.daemon.questions import Question, QuestionChangedError, digest_of
from shearloop.daemon.running_rig import RunningRig
from shearloop.daemon.sensors import Sensors
from shearloop.daemon.supervisor import HealthReporter, error_text
from shearloop.errors import UserError
from shearloop.printable import printable

if TYPE_CHECKING:
    # Only a rig with a robot loads them.
    from shearloop.daemon.configured_experiment import ConfiguredExperiment
    from shearloop.daemon.rig import Rig

# The arguments of each command that acts, with their types.
ARGUMENTS: Mapping[str, Mapping[str, type]] = {
    "tare": {"source": str, "confirmed": bool},
    "start": {"experiment": str, "confirmed": bool, "ask": bool, "digest": str},
    "unlock": {"confirmed": bool, "digest": str, "stop": int},
    "release": {"confirmed": bool, "ask": bool, "digest": str},
}
# Arguments that each of them may have: the process that it is meant for, when the operator asked for it at the
# earliest, until when it may begin, and the sender's own name of the request.
_OF_ALL: Mapping[str, type] = {"instance": str, "asked_ns": int, "until_ns": int, "request_id": str}
_KINDS: Mapping[type, str] = {bool: "true or false", int: "a whole number", str: "text"}
PAUSE = "pause"
STOP_DELAY_S = 0.05
# A request that does not say when it was asked for may be this old.
_OLDEST_S = 5.0
# A later time is of another clock, such as Unix time.
_LONGEST_AHEAD_NS = 86_400 * 10**9
_LOOK_AGAIN = "look at the rig, and send it again"
_ANOTHER_DAEMON = f"it is meant for an earlier daemon, and this one has begun since; {_LOOK_AGAIN}"


class TareRefusal(Protocol):
    """Says why no zero may be taken at present."""

    def __call__(self, *, confirmed: bool = False) -> str | None:
        """Return why not, or None; `confirmed`: the operator says that nothing is loaded."""


class Answered(NamedTuple):
    """A command's name and request, and why it was refused, or None."""

    name: str
    request: Request
    refusal: str | None


@dataclass(slots=True)
class Commands:
    """Executes the commands of the command socket.

    `experiment` is the configured one; setting `daemon_end` ends the daemon.
    """

    rig: "Rig | None"
    sensors: Sensors
    experiment: "ConfiguredExperiment | None"
    health: HealthReporter
    daemon_end: asyncio.Event
    # Why no zero may be taken at present, by the control loop or by the sensors alone.
    tare_refusal: TareRefusal
    # Receives each answered command, except questions.
    report: Callable[["Answered"], None] = lambda _: None
    running_rig: RunningRig = field(default_factory=RunningRig)
    now_ns: Callable[[], int] = boot_ns
    # The latest `stop` or `pause`, and when it came, by `now_ns`.
    _latest_halt: tuple[str, int] | None = field(default=None, init=False)
    # Sender, `request_id` and refusal of the latest stops that have one.
    _latest_stops: deque[tuple[Any, Any, str | None]] = field(default_factory=lambda: deque(maxlen=16), init=False)

    def handlers(self) -> Mapping[str, Handler]:
        """Return the handler of every command."""
        asking = {STATUS: self._status, EXPERIMENTS: self._experiments}
        acting = {name: partial(self._reported, name, handler) for name, handler in self._acting().items()}
        return {**asking, **acting}

    def _acting(self) -> Mapping[str, Handler]:
        return {
            "tare": self._tare,
            STOP: self._stop,
            "start": self._start,
            PAUSE: self._pause,
            "resume": self._resume,
            "unlock": self._unlock,
            "release": self._release,
        }

    async def _reported(self, name: str, handler: Handler, request: Request) -> Reply:
        """Carry out a command, and report its result."""
        refusal: str | None = f"{name} was ended before it was done"
        try:
            check_arguments(name, request)
            if name != STOP and not self._is_for_this_one(request):
                raise CommandRefusedError(_ANOTHER_DAEMON)
            if name not in MAY_BE_UNBOUND and not request.get("ask"):
                _refuse_if(_why_unbound(name, request, self.now_ns()) or self._why_halted_since(request))
            if name not in NEVER_LATE:
                _refuse_if(self._deadline(request).why_passed())
            if name in (STOP, PAUSE):
                self._latest_halt = name, self.now_ns()
            reply = await handler(request)
            refusal = None
        except CommandRefusedError as error:
            refusal = str(error)
            raise
        except Exception as error:
            refusal = f"{name} failed ({error_text(error)}); see the daemon's log"
            raise
        finally:
            if not request.get("ask") and not self._is_told_again(name, request, refusal):
                self.report(Answered(name, request, refusal))
        return reply

    def _why_halted_since(self, request: Request) -> str | None:
        """Return why a stop or a pause, which can overtake an older request, ends one that lets something move."""
        if self._latest_halt is None:
            return None
        (halt, came_ns), now_ns = self._latest_halt, self.now_ns()
        asked_ns = request.get("asked_ns")
        if asked_ns is None or asked_ns > now_ns:
            ago_s = (now_ns - came_ns) / 1e9
            unsure = "and without `asked_ns` by the daemon's clock nothing shows that this request was asked for later"
            cure = f"{_LOOK_AGAIN} with it, or {_OLDEST_S:g} s after the {halt}"
            return f"a {halt} came {ago_s:.1f} s ago, {unsure}; {cure}" if ago_s <= _OLDEST_S else None
        return f"a {halt} came after it was asked for; {_LOOK_AGAIN}" if asked_ns <= came_ns else None

    def _is_for_this_one(self, request: Request) -> bool:
        """Return whether a request is meant for this daemon, and not for one before it."""
        return bool(request.get("instance", self.running_rig.instance) == self.running_rig.instance)

    def _is_told_again(self, name: str, request: Request, refusal: str | None) -> bool:
        """Return whether this is one more request of the same stop, which a client sends again where it has to."""
        if name != STOP or "request_id" not in request:
            return False
        act = request.get("by"), request["request_id"], refusal
        again = act in self._latest_stops
        self._latest_stops.append(act)
        return again

    def _deadline(self, request: Request) -> Deadline:
        return Deadline(request.get("until_ns"), self.now_ns(), self.now_ns)

    async def _experiments(self, _request: Request) -> Reply:
        """Return the experiments that `start` may name, and the configured one, which it runs without a name.

        Where none were read before, and none can be read now, there are none, and `unread` says why.
        """
        rig = required_rig(self.rig)
        try:
            found = await rig.experiments.list(rig.reading_refusal)
        except UserError as error:
            raise CommandRefusedError(str(error)) from error
        own = str(self.experiment.path) if self.experiment is not None else ""
        known = [{"path": path, "name": name} for path, name in found.names.items()]
        reply: dict[str, Any] = {"experiments": known, "configured": own}
        if found.unread:
            reply["unread"] = found.unread
        return reply

    def keyless_handlers(self) -> Mapping[str, Handler]:
        """Return the handlers for users of this machine without a key: only `stop` and `status` work."""

        async def refuse(_request: Request) -> Reply:
            reason = "this command needs a key: give --key and --server-key; without one only `stop` works"
            raise CommandRefusedError(reason)

        return {name: own if name in (STOP, STATUS) else refuse for name, own in self.handlers().items()}

    async def _start(self, request: Request) -> Reply:
        path = request.get("experiment") or (self.experiment.path if self.experiment is not None else None)
        if not isinstance(path, str | Path):
            raise CommandRefusedError("no experiment is given: name its file, or one in the configuration")
        rig = required_rig(self.rig)
        try:
            if request.get("ask"):
                _refuse_if(rig.start_refusal())
                experiment = await rig.experiments.read(Path(path))
                # The files above were found unchanged, so that this module is of the daemon's version.
                from shearloop.daemon.operator_questions import file_refusal

                _refuse_if(file_refusal(rig.control_loop.operator, experiment.file))
                return dict(rig.question_of(experiment).facts)
            digest, confirmed = request.get("digest"), bool(request.get("confirmed"))
            _refuse_if(await rig.start(Path(path), digest, self._deadline(request), confirmed=confirmed))
        except QuestionChangedError as error:
            raise CommandRefusedError(str(error), **error.question.facts) from error
        except InvalidExperimentError as error:
            raise CommandRefusedError(str(error), invalid=True) from error
        except UserError as error:
            raise CommandRefusedError(str(error)) from error
        if self.experiment is not None:
            self.experiment.on_begun(Path(path))
        return {"experiment": str(path), "run": rig.control_loop.runs}

    async def _pause(self, _request: Request) -> Reply:
        _refuse_if(required_rig(self.rig).control_loop.pause())
        return {}

    async def _resume(self, _request: Request) -> Reply:
        _refuse_if(required_rig(self.rig).control_loop.resume())
        return {}

    async def _unlock(self, request: Request) -> Reply:
        # It is loaded with the rig.
        from shearloop.daemon.control.operator_view import release_stakes, unlock_question

        rig = required_rig(self.rig)
        loop, confirmed = rig.control_loop, bool(request.get("confirmed"))
        _refuse_if(rig.runner.unlock_refusal())
        # A stop since the latest state waits too.
        rig.runner.decide_now()
        another, drops = loop.operator.why_another_stop(request.get("stop")), unlock_question(loop.operator)
        if another or drops:
            sentence = "; ".join(filter(None, (another, drops)))
            what = "drops" if drops else "acknowledges", f"stop {loop.safety.stop_number}"
            question = Question(
                f"Unlock? {_capital(sentence)}.",
                digest_of("unlock", *what, *rig.occasion(), *release_stakes(loop.operator)),
            )
            if another and request.get("digest") != question.digest:
                raise CommandRefusedError(f"{another}; look at the rig, and unlock it again", **question.facts)
            if drops and not confirmed:
                reason = f"{sentence}; secure it, then confirm it with `shearloop command unlock --yes`"
                raise CommandRefusedError(reason, **question.facts)
            _refuse_if_changed(question, sentence, request)
        _refuse_if(await rig.runner.unlock(self._deadline(request), confirmed=confirmed))
        return {}

    async def _release(self, request: Request) -> Reply:
        from shearloop.daemon.control.operator_view import release_question, release_stakes

        rig = required_rig(self.rig)
        _refuse_if(rig.runner.release_refusal())
        sentence = release_question(rig.control_loop.operator)
        question = Question(
            f"Release? {_capital(sentence)}.",
            digest_of("release", *rig.occasion(), *release_stakes(rig.control_loop.operator)),
        )
        if request.get("ask"):
            return dict(question.facts)
        if not request.get("confirmed"):
            raise CommandRefusedError(f"{sentence}; confirm it with `shearloop command release --yes`")
        _refuse_if_changed(question, sentence, request)
        _refuse_if(await rig.runner.release(self._deadline(request)))
        # A daemon that is killed after the answer must not leave the grip that is gone.
        await rig.memory.save_present()
        return {}

    async def _tare(self, request: Request) -> Reply:
        sensors = self.sensors.tareable
        source = request.get("source")
        if source is not None and not (isinstance(source, str) and source in sensors):
            raise CommandRefusedError(f"there is no sensor {source!r} to tare; there are {', '.join(sensors)}")
        names = list(sensors) if source is None else [source]
        confirmed, tasks = bool(request.get("confirmed")), self.health.tasks()
        _refuse_if(self.tare_refusal(confirmed=confirmed))
        lost = [name for name in names if tasks.get(name, {}).get("connected") is False]
        taring = [name for name in names if name not in lost]
        if not taring:
            them = "them" if lost[1:] else "it"
            raise CommandRefusedError(f"not connected: {' and '.join(lost)}; connect {them}, then send the tare again")
        for name in taring:
            sensors[name].tare(confirmed=confirmed)
        reply: dict[str, Any] = {"taring": taring}
        if lost:
            reply["not_connected"] = lost
        return reply

    async def _status(self, _request: Request) -> Reply:
        tasks = self.health.tasks()
        daemon = {"process": os.getpid(), "folder": os.getcwd(), "now_ns": self.now_ns(), **asdict(self.running_rig)}
        if self.rig is None:
            return {"tasks": tasks, "daemon": daemon}
        return {"tasks": tasks, "daemon": daemon, "loop": self.rig.state(), "cap": self.health.cap()}

    async def _stop(self, request: Request) -> Reply:
        # The instance shows a page that it displayed another daemon.
        return {**self._stopped(request), "process": os.getpid(), "instance": self.running_rig.instance}

    def _stopped(self, request: Request) -> Reply:
        """Stop a motion or the beginning of one, else the daemon; return what was stopped."""
        # An unknown argument may be a misspelt `spare_daemon`.
        spare_daemon = bool(request.get("spare_daemon") or request.keys() - {"command", "by", "spare_daemon", *_OF_ALL})
        held = self.rig.control_loop.tool.any_object if self.rig is not None else None
        stopped, ended = None, {}
        if self.rig is not None:
            ended = self.rig.runner.just_ended()
            # If the gripper may hold something, a stop keeps the daemon, and the next start waits.
            stopped = self.rig.runner.stop(also_idle=spare_daemon or held is not None)
        waiting = self.experiment.call_off() if self.experiment is not None else None
        if stopped is not None:
            return {"stopped": stopped}
        if spare_daemon:
            # The live page's stop button stops motion, but not the daemon.
            return {"stopped": "", **ended} if waiting is None else {"stopped": f"the start of {waiting.name}"}
        if held is not None:
            # An operator who stops twice must still be able to open the gripper.
            return {"stopped": "", "held": held, **ended}
        if "ended_by_itself" in ended:
            return {"stopped": "", **ended}
        if not self._may_end_daemon(request):
            return {
                "stopped": "",
                "idle": True,
                **ended,
                "daemon": {"instance": self.running_rig.instance, "now_ns": self.now_ns()},
            }
        # Nothing moves, so the daemon itself stops, once the reply is sent.
        asyncio.get_running_loop().call_later(STOP_DELAY_S, self.daemon_end.set)
        return {"ended": True, **ended}

    def _may_end_daemon(self, request: Request) -> bool:
        """Return whether a stop where nothing moves may end the daemon: it is known to be of now, and for this one.

        An older one may have waited on its way, and the daemon may be in use again.
        """
        is_dated = type(request.get("until_ns")) is int
        return self._is_for_this_one(request) and is_dated and self._deadline(request).why_passed() is None


def check_arguments(name: str, request: Request) -> None:
    """Raise CommandRefusedError for an argument that a command does not have, or of another type.

    A misspelt `experiment` would start the configured one, and a `confirmed` of "no" would confirm.
    `stop` accepts any argument.
    """
    if name == STOP:
        return
    own = ARGUMENTS.get(name, {})
    known = {**own, **_OF_ALL}
    for key, value in request.items():
        if key in ("command", "by"):
            continue
        if key not in known:
            has = f"; it has {', '.join(own)}" if own else "; it has none"
            raise CommandRefusedError(f"`{name}` has no argument {printable(key)[:40]!r}{has}")
        if type(value) is not known[key] or value == "":
            raise CommandRefusedError(f"`{key}` is {printable(repr(value))[:40]}, and has to be {_KINDS[known[key]]}")


def _why_unbound(name: str, request: Request, now_ns: int) -> str | None:
    """Return which arguments are missing, or of another clock, that bind a request to a time and a daemon, or None.

    The clock of `until_ns` begins again with the computer, so the daemon's `instance` belongs to it.
    """
    missing = [f"`{key}`" for key in ("instance", "until_ns") if key not in request]
    take = "from the reply to `status`, as docs/messages.md says"
    if missing:
        are = "are" if missing[1:] else "is"
        why = f"{' and '.join(missing)} {are} missing, and this {name} may be an old one that waited on its way"
        return f"{why}: take them {take}"
    if request["until_ns"] - now_ns > _LONGEST_AHEAD_NS:
        return f"`until_ns` is more than a day ahead, and this {name} would never be too late: take the clock {take}"
    return None


def required_rig(rig: "Rig | None") -> "Rig":
    """Return the rig; raises CommandRefusedError without a rig."""
    if rig is None:
        raise CommandRefusedError("the configuration has no robot; add `robot: ur.yaml` to it")
    return rig


def _refuse_if(reason: str | None) -> None:
    if reason:
        raise CommandRefusedError(reason)


def _refuse_if_changed(question: Question, sentence: str, request: Request) -> None:
    """Refuse a confirmation of an earlier question, and return the present question."""
    if request.get("digest", question.digest) != question.digest:
        changed = f"the gripper's state has changed since the question, or something was stopped or run: {sentence}"
        changed += "; answer it again"
        raise CommandRefusedError(changed, **question.facts)


def _capital(sentence: str) -> str:
    return f"{sentence[0].upper()}{sentence[1:]}"
