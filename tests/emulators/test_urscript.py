"""URScript in the emulated controller: what programs compute, how their threads run, and how they end."""

from contextlib import suppress

import pytest

from shearloop.emulators.ur_arm import Arm
from shearloop.emulators.urscript import Program, ProgramEndedError, Registers

COUNTING = "global n = 0\nthread t():\nwhile n < 7:\nn = n + 1\nsync()\nend\nend\n"


def program(text: str, registers: Registers | None = None) -> Program:
    return Program(f"def main():\n{text}\nend\n", Registers() if registers is None else registers, Arm(), print)


def run(text: str, cycles: int = 20) -> tuple[list[float], str]:
    """Return the first output registers and why the program ended."""
    registers, why = Registers(), ""
    try:
        running = program(text, registers)
        for cycle in range(cycles):
            running.cycle(0.002, 0.002 * cycle)
    except ProgramEndedError as ended:
        why = str(ended)
    return [registers[f"output_double_register_{number}"] for number in range(3)], why


@pytest.mark.parametrize(
    ("text", "written"),
    [
        # A comment, and blocks.
        ("x = 2 # one\nif x == 1:\nx = 10\nelif x == 2:\nx = 20\nelse:\nx = 30\nend\nout(0, x)", 20),
        ("x = 0\nwhile True:\nx = x + 1\nif x > 4:\nbreak\nend\nend\nout(0, x)", 5),
        # Statements that begin and end within lines, as in ur-rtde's head.
        ("global a = # offset\n0    global b = # offset\n7    global c = 1\nout(0, b + c)", 8),
        ("global a = 1\ndef f():\na = a + 1\nreturn a * 10\nend\nx = f() + f()\nout(0, x)", 50),
        # A parameter and a local variable hide nothing of others.
        ("global p = 1\ndef f(p):\nq = p\nreturn q\nend\nq = 5\nout(0, f(2) + p + q)", 8),
        # Lists are values; `p[…]` is a pose or an entry.
        ("a = [1, 2]\nb = a\nb[0] = 9\nout(0, a[0] * 10 + b[0])", 19),
        ("p = p[4, 3, 0, 0, 0, 0]\nout(0, norm([p[0], p[1]]) + norm(-2) + sqrt(9))", 10),
        # A name that Python keeps for itself.
        ("async = 3\nout(0, async)", 3),
        # A thread, which ends itself or is killed.
        (COUNTING + "h = run t()\nwait(9)\nout(0, n)", 7),
        (COUNTING + "h = run t()\nwait(4)\nkill h\nwait(5)\nout(0, n)", 3),
        # Nothing else runs during a critical section.
        (COUNTING + "enter_critical\nh = run t()\nwait(5)\nm = n\nexit_critical\nwait(2)\nout(0, 10 * m + n)", 2),
    ],
)
def test_program_computes(text, written):
    """`out` writes an output register and `wait` uses up cycles."""
    helpers = (
        "def out(number, value):\nwrite_output_float_register(number, value)\nend\n"
        "def wait(cycles):\nleft = cycles\nwhile left > 0:\nleft = left - 1\nsync()\nend\nend\n"
    )
    (value, *_), why = run(helpers + text)
    assert (value, why) == (written, "it has run to its end")


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("while True:\nx = 1\nend", "without sync"),
        ("freedrive_mode()", "freedrive_mode"),
        ("halt\nwhile True:\nsync()\nend", "halted itself"),
        ("x = [1, 2]\ny = x[5]", "index"),
        ("write_output_integer_register(0, 1.5)", "not an integer"),
        ("x = read_input_float_register(48)", "no register 48"),
        ("thread t():\nspeedj([0, 0, 0, 0, 0, 1], a=1)\nend\nh = run t()\nsync()\nsync()\nstopj(1)", "another thread"),
        ('rtde_set_watchdog("input_int_register_0", 100, "stop")\nwhile True:\nsync()\nend', "watchdog"),
    ],
)
def test_program_ends_for_a_cause(text, why):
    assert why in run(text)[1]


@pytest.mark.parametrize(("critical", "seen"), [(False, 3.0), (True, 1.0)])
def test_a_thread_is_interrupted_between_statements_outside_critical_sections(critical, seen):
    """The main thread is held for two cycles wherever it may be; another thread counts meanwhile."""
    enter, leave = ("enter_critical\n", "exit_critical\n") if critical else ("", "")
    text = (
        "def main():\nglobal n = 0\nthread t():\nwhile True:\nn = n + 1\nsync()\nend\nend\n"
        f"h = run t()\nsync()\nsync()\n{enter}write_output_float_register(1, 0)\n"
        f"write_output_float_register(0, n)\n{leave}halt\nend\n"
    )
    registers = Registers()
    held = iter([True, True])

    def interrupts(thread: int) -> bool:
        began = "output_double_register_1" in registers
        return thread == 1 and began and next(held, False)

    running = Program(text, registers, Arm(), print, interrupts=interrupts)
    for cycle in range(6):
        with suppress(ProgramEndedError):
            running.cycle(0.002, 0.002 * cycle)
    assert registers["output_double_register_0"] == seen


@pytest.mark.parametrize("text", ["while True:", "end", "end\nend\ndef f():\ndef g():", "x = = 2", "if x\nend"])
def test_text_with_mistakes_is_no_program(text):
    with pytest.raises(SyntaxError):
        program(text)


@pytest.mark.parametrize(
    ("text", "why"),
    [
        # A function of Python's.
        ("x = open(1)", "open is not defined"),
        ("stopj()", "stopj takes other arguments"),
        ("stopj(1, 2)", "stopj takes other arguments"),
        ("speedj([0, 0, 0, 0, 0, 1], v=1)", "speedj takes other arguments"),
        ("def f(a):\nsync()\nend\nf()", "f takes other arguments"),
        ("x = y + 1", "y is not defined"),
        # Of another function, and not global.
        ("def f():\nx = z\nend\nz = 1\nf()", "z is not defined"),
        ("def f():\nsync()\nend\nh = run f()", "f is not a thread"),
        (f"{COUNTING}t()", "t is a thread"),
    ],
)
def test_a_program_with_an_unknown_name_or_wrong_arguments_does_not_start(text, why):
    with pytest.raises(SyntaxError, match=why):
        program(text)
