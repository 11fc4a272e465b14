"""An operator of an emulated rig: each question has its action and its answer."""

from collections.abc import Callable

from shearloop.tools.commission.operator import Operator

GAUGES_MM, OBJECTS_MM = (10, 30, 50, 70, 90), (8, 60, 25, 40)
# Of the emulated gel and lever in series.
SPRING_NM_PER_RAD = 1.0 / (1.0 / 0.8 + 1.0 / 20.0)


class ScriptedOperator:
    """Answers by a part of the question; `order` has the rig do something, `stop_program` stops the robot's program."""

    def __init__(self, order: Callable[[str], None], stop_program: Callable[[], None]) -> None:
        self.said: list[str] = []
        self.asked: list[str] = []
        # A motion with these words is not allowed.
        self.declined = ""
        self._order, self._stop_program = order, stop_program
        self._answers: dict[str, Callable[[str], str]] = {
            "Your name": lambda _: "Ada",
            "checksum": lambda _: "A1B2",
            "Hold gauge": lambda question: self._hold(GAUGES_MM[_number(question)]),
            "Hold object": lambda question: self._hold(OBJECTS_MM[_number(question)], "done"),
            "everything out": lambda _: self._do("object none"),
            "pendant to 50%": lambda _: self._do("slider 0.5"),
            "slider back": lambda _: self._do("slider 1"),
            "Now press the emergency": lambda _: self._do("emergency-stop"),
            "release the emergency": lambda _: self._do("release"),
            "Now press the stop of the program": lambda _: self._stop(),
            "Now pull": lambda _: self._do("silence robot 1.2"),
            "mass in kg": lambda _: self._do("hang 1", "1"),
            "Take the mass": lambda _: self._do("hang 0"),
            "known torque and let": lambda _: self._do("weigh 0.1", "0.1"),
            "Take the known torque": lambda _: self._do("weigh 0"),
            "Put the tool": lambda _: self._hold(20, "done"),
            "Press the tool": lambda _: self._do("kick 0.1"),
            "known stiffness": lambda _: self._hold(20, str(SPRING_NM_PER_RAD)),
            "Which way": lambda _: "counterclockwise",
        }

    @property
    def operator(self) -> Operator:
        return Operator(self._answer, self.said.append, allows=True)

    def _answer(self, question: str) -> str:
        self.asked.append(question)
        if self.declined and self.declined in question:
            return "no"
        for part, answer in self._answers.items():
            if part in question:
                return answer(question)
        return "move" if "MOTION" in question else "done"

    def _do(self, command: str, answer: str = "done") -> str:
        self._order(command)
        return answer

    def _hold(self, width_mm: float, answer: str = "") -> str:
        self._order(f"object {width_mm}")
        return answer or str(width_mm)

    def _stop(self) -> str:
        self._stop_program()
        return "done"


def _number(question: str) -> int:
    """Return the index in `gauge 2 of 5`."""
    return int(question.split(" of ", maxsplit=1)[0].rsplit(maxsplit=1)[-1]) - 1
