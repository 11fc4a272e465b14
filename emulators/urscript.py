"""Runs URScript as a controller does: a client's text, translated to Python, one control cycle at a time.

Source: UR's script manual. Statements become Python statements and functions generators, so that a function may use up
cycles. Expressions are Python's already, but for poses (`p[…]`). A program does not start with an unknown name, with
wrong arguments, or with a block that has no end. It plays the functions of our script, and those that ur-rtde's needs
for the same commands, and ends when it calls another one. It also ends, as on a controller, when two threads move the
arm, or when a watchdog is not fed. Scopes are simpler: a variable is global where it is declared so.

A thread runs until it has used up a cycle. A controller also interrupts one that has computed for too long, until the
next cycle (UR's page "Thread scheduling"). `Interrupts` decides where, between statements outside critical sections.
"""

import ast
import keyword
import math
import re
from collections import defaultdict
from collections.abc import Callable, Iterator
from functools import lru_cache, partial
from types import CodeType
from typing import Any

import numpy as np

from shearloop.drivers.ur.script import LOWER, UPPER
from shearloop.emulators.ur_arm import Arm, LinearMove
from shearloop.emulators.urscript_names import E_SERIES_ONLY, check_names

# An event's name and detail.
Event = tuple[str, str]
Thread = Iterator[None]
# Whether a thread, by its number, is interrupted now. The main one is number 1.
Interrupts = Callable[[int], bool]

# The first integer register of each half.
COMMANDS = ("input_int_register_0", "input_int_register_24")
# The registers with the script's clock.
CLOCKS = (LOWER.clock, UPPER.clock)
# What remains of 0.002 s that is added to 1024 s in 32 bits.
FLOAT_LOSS = float(np.float32(1024.0) + np.float32(0.002) - np.float32(1024.0)) / 0.002
# More loops than this within one cycle never end.
MAX_LOOPS = 10_000
# The registers of each type and direction.
_REGISTERS = range(48)
# Functions that use up cycles.
_LASTING = ("sync", "speedj", "movel", "stopj", "stopl")
_SAME_KEYWORDS = {"and", "or", "not", "if", "elif", "else", "while", "def", "return", "break", "continue", "global"}
_SAME_KEYWORDS |= {"True", "False", "pass"}
# Strings stay as they are.
_RENAMED = re.compile(rf"(\"[^\"\n]*\")|\b({'|'.join(set(keyword.kwlist) - _SAME_KEYWORDS)})\b")


class ProgramEndedError(Exception):
    """The program ends by itself; the message says why."""


class Registers(defaultdict[str, float]):
    """The RTDE registers by name; they outlive programs and clients."""

    def __init__(self) -> None:
        """Set every register to 0."""
        super().__init__(int)
        # When each input register was last written.
        self.written_s: defaultdict[str, float] = defaultdict(float)
        # A fault: the script's clock loses what a sum of cycles in 32-bit floats loses after 17 minutes.
        self.counts_as_float = False
        # A fault: a watchdog does not look while the arm moves straight.
        self.watchdog_waits = False

    def write(self, name: str, value: float, now_s: float) -> None:
        """Set an input register, as a client does over RTDE."""
        self[name] = value
        self.written_s[name] = now_s


class _Expressions(ast.NodeTransformer):
    """Turns URScript's expressions into Python's."""

    def __init__(self, lasting: set[str]) -> None:
        self._lasting = lasting

    def visit_Call(self, node: ast.Call) -> ast.AST:
        """Wait for a function that may use up cycles."""
        self.generic_visit(node)
        waits = isinstance(node.func, ast.Name) and node.func.id in self._lasting
        return ast.copy_location(ast.YieldFrom(node), node) if waits else node

    def visit_Subscript(self, node: ast.Subscript) -> ast.AST:
        """Distinguish a pose, `p[x, y, z, rx, ry, rz]`, from an entry of a variable p."""
        self.generic_visit(node)
        if isinstance(node.value, ast.Name) and node.value.id == "p" and isinstance(node.slice, ast.Tuple):
            return ast.copy_location(ast.List(node.slice.elts, ast.Load()), node)
        return node


@lru_cache(maxsize=8)
def translate(text: str, *, interruptible: bool = False) -> tuple[CodeType, str, frozenset[str]]:
    """Return the compiled Python of a program, the name of its main function, and the controller's functions in it.

    An `interruptible` program asks before each statement whether its thread is interrupted.

    Raises:
        SyntaxError: a controller would not start it.
    """
    text = re.sub(r'("[^"\n]*")|#.*', lambda found: found[1] or "", text)
    # A statement may begin within a line and end within another: ur-rtde's first two do.
    text = re.sub(r"=[ \t]*\n\s*", "= ", text)
    text = re.sub(r"(?<=\S)[ \t]+(?=global\b)", "\n", text)
    text = _RENAMED.sub(lambda found: found[1] or f"{found[2]}_", text)
    declared = set(re.findall(r"\bglobal (\w+)", text))
    functions = re.findall(r"^\s*(?:def|thread) (\w+)\(", text, re.MULTILINE)
    if not functions:
        raise SyntaxError("it has no function")
    depth, lines = 0, []
    for line in filter(None, map(str.strip, text.splitlines())):
        if line == "end":
            depth -= 1
            if depth < 0:
                raise SyntaxError("an end has no block")
            continue
        goes_on = line.startswith(("elif ", "else:"))
        if interruptible and depth > 0 and not goes_on:
            lines.append("    " * depth + "while is_interrupted(): yield")
        lines.append("    " * (depth - goes_on) + _statement(line))
        if line.endswith(":"):
            depth += not goes_on
            lines += ["    " * depth + one for one in _opening(line, declared)]
    if depth != 0:
        raise SyntaxError("a block has no end")
    tree = ast.parse("\n".join(lines))
    called = check_names(tree, set(re.findall(r"^\s*thread (\w+)\(", text, re.MULTILINE)))
    tree = _Expressions({*functions, *_LASTING}).visit(tree)
    return compile(tree, "URScript", "exec"), functions[0], called


def _statement(line: str) -> str:
    """Return a statement in Python; expressions stay."""
    line = re.sub(r"^thread ", "def ", re.sub(r"^global ", "", line))
    line = re.sub(r"^(enter_critical|exit_critical|halt)$", r"\1()", re.sub(r"^kill (\w+)$", r"kill(\1)", line))
    # Lists are values: to set an entry makes a new list.
    line = re.sub(r"^(\w+)\[(\w+)\] = (.+)$", r"\1 = put(\1, \2, \3)", line)
    return re.sub(r"\brun (\w+)\(\)", r"run(\1)", line)


def _register(kind: str, address: int) -> str:
    """Return the name of a register; ValueError where there is none."""
    if address not in _REGISTERS:
        raise ValueError(f"there is no register {address}")
    return f"{kind}_register_{address}"


def _opening(line: str, declared: set[str]) -> list[str]:
    """Return the first statements of the block that `line` opens."""
    if line.startswith("while"):
        return ["count_loop()"]
    if not line.startswith(("def ", "thread ")):
        return ["pass"]
    names = declared.difference(re.findall(r"\w+", line))
    return [*([f"global {', '.join(sorted(names))}"] if names else []), "if False: yield"]


class Program:
    """One run of a program, from its upload to its end."""

    def __init__(
        self,
        text: str,
        registers: Registers,
        arm: Arm,
        log: Callable[[str], None],
        *,
        e_series: bool = True,
        interrupts: Interrupts | None = None,
    ) -> None:
        """Begin; SyntaxError where the text is no program. `log` gets the messages for the pendant's log.

        Without `e_series` the controller lacks the functions that came with that generation.
        """
        self._registers, self._arm, self._log, self._interrupts = registers, arm, log, interrupts
        self._step_s = 0.0
        self._events: list[Event] = []
        self._watchdogs: dict[str, float] = {}
        code, main, called = translate(text, interruptible=interrupts is not None)
        if not e_series and (unknown := called & E_SERIES_ONLY):
            raise SyntaxError(f"name {min(unknown)} is not defined")
        names = self._functions()
        exec(code, names)  # noqa: S102
        # By number; the main one is number 1, and the program ends with it.
        self._threads: dict[int, Thread] = {1: names[main]()}
        # The numbers of the running thread, the one in a critical section, and the one that moves the arm; or 0.
        self._running = self._critical = self._mover = 0
        self._started, self._loops = 1, 0

    def _functions(self) -> dict[str, Any]:
        """Return the functions of URScript by name: the public methods, and what takes one line."""
        registers, arm = self._registers, self._arm
        methods = {name: getattr(self, name) for name in vars(Program) if not name.startswith("_") and name != "cycle"}
        return methods | {
            "read_input_float_register": lambda address: registers[_register("input_double", address)],
            "read_input_integer_register": lambda address: int(registers[_register("input_int", address)]),
            "write_output_float_register": partial(self._write_output, "double"),
            "write_output_integer_register": partial(self._write_output, "int"),
            "get_actual_joint_positions": lambda: [*map(float, arm.q_rad)],
            "get_actual_joint_speeds": lambda: [*map(float, arm.measured_rad_per_s)],
            "get_tcp_force": lambda: [*map(float, arm.wrench)],
            "get_steptime": lambda: self._step_s,
            "movel": lambda pose, a, v: self._move(arm.move_to, np.array(pose), v, a),
            "stopj": lambda a: self._move(arm.halt, a),
            "stopl": lambda a: self._move(arm.halt_on_line, a),
            "norm": lambda value: math.hypot(*value) if isinstance(value, list) else abs(value),
            "put": lambda values, index, value: [*values[:index], value, *values[index + 1 :]],
            "sqrt": math.sqrt,
            "textmsg": lambda *parts: self._log("".join(map(str, parts))),
            # Force mode is not played.
            **dict.fromkeys(("force_mode_set_gain_scaling", "force_mode_set_damping"), lambda *_: None),
            "__builtins__": {},
        }

    def cycle(self, step_s: float, now_s: float) -> list[Event]:
        """Run each thread until it has used up this cycle; return what happened.

        Raises:
            ProgramEndedError: the program ends.
        """
        self._step_s, self._events = step_s, []
        waits = self._registers.watchdog_waits and isinstance(self._arm.motion, LinearMove)
        for name, period_s in self._watchdogs.items() if not waits else ():
            # Writes from before the program count: the manual does not say that the time begins here.
            if now_s - self._registers.written_s[name] > period_s:
                raise ProgramEndedError("the RTDE watchdog was not fed")
        for number in list(self._threads):
            if number in self._threads and self._critical in (0, number):
                self._running, self._loops = number, 0
                self._advance(number)
        return self._events

    def _advance(self, number: int) -> None:
        try:
            next(self._threads[number])
        except StopIteration:
            del self._threads[number]
            if number == 1:
                raise ProgramEndedError("it has run to its end") from None
        except (NameError, TypeError, ValueError, IndexError, ArithmeticError) as error:
            raise ProgramEndedError(f"the emulated controller cannot play this: {error}") from error

    def is_interrupted(self) -> bool:
        """Return whether the running thread does nothing more in this cycle."""
        return self._critical == 0 and self._interrupts is not None and self._interrupts(self._running)

    def run(self, function: Callable[[], Thread]) -> int:
        """Start a thread in the next cycle and return its number."""
        self._started += 1
        self._threads[self._started] = function()
        return self._started

    def kill(self, number: int) -> None:
        """End a thread."""
        if self._threads.pop(number, None) is not None and self._mover == number:
            self._mover = 0

    def enter_critical(self) -> None:
        """Let no other thread run."""
        self._critical = self._running

    def exit_critical(self) -> None:
        """Let all threads run."""
        self._critical = 0

    def halt(self) -> None:
        """End the program."""
        raise ProgramEndedError("it has halted itself")

    def count_loop(self) -> None:
        """End a program with a loop that takes no cycle."""
        self._loops += 1
        if self._loops > MAX_LOOPS:
            raise ProgramEndedError("a loop without sync() does not end")

    def sync(self) -> Thread:
        """Use up the rest of the cycle."""
        yield

    def speedj(self, qd: list[float], a: float, t: float | None = None) -> Thread:
        """Turn towards joint speeds; return after the time `t`, or once they are reached, after a cycle at least."""
        self._claim_arm()
        target = np.array(qd, dtype=float)
        self._arm.turn(target, a)
        yield
        if t is None:
            while not np.array_equal(self._arm.qd_rad_per_s, target):
                yield
        else:
            for _ in range(1, round(t / self._step_s)):
                yield
        self._mover = 0

    def _move(self, begin: Callable[..., None], *values: Any) -> Thread:
        """Begin a motion of the arm; return at its end."""
        self._claim_arm()
        begin(*values)
        motion = self._arm.motion
        while motion is not None and self._arm.motion is motion:
            yield
        self._mover = 0

    def _write_output(self, kind: str, address: int, value: float) -> None:
        if kind == "int" and type(value) is not int:
            raise TypeError(f"{value} is not an integer")
        name = _register(f"output_{kind}", address)
        loses = self._registers.counts_as_float and name in CLOCKS
        self._registers[name] = FLOAT_LOSS * value if loses else value

    def _claim_arm(self) -> None:
        if self._mover not in (0, self._running):
            raise ProgramEndedError("another thread is already controlling the robot")
        self._mover = self._running

    def rtde_set_watchdog(self, name: str, hz: float, action: str) -> None:
        """End the program from now on when this register is written less often."""
        if action != "stop":
            raise ValueError(f"a watchdog with the action {action}")
        self._watchdogs[name] = 1.0 / hz
        self._events.append(("watchdog-armed", f"{hz:g} Hz"))

    def zero_ftsensor(self) -> None:
        """Make the present wrench zero."""
        self._arm.zero_wrench()
        self._events.append(("wrench-zeroed", ""))
