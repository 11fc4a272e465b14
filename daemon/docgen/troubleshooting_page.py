"""`docs/troubleshooting.md` and the table of `docs/safety.md`: every sentence an operator may read, with its cure."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

from shearloop.daemon.control.safety import TABLE, Response
from shearloop.daemon.docgen.markdown import table
from shearloop.daemon.docgen.sentences import Sentence, raised, told

RESPONSES = {
    Response.NOTE: "told, nothing else",
    Response.REFUSE_START: "no experiment is begun; what runs goes on",
    Response.HOLD: "the wrist stands still until it is over",
    Response.STOP_AND_KEEP_GRIP: "stopped, the tool stays gripped",
    Response.STOP_AND_RELEASE: "stopped, the gripper opens",
}


@dataclass(frozen=True, slots=True)
class Section:
    """Some modules whose sentences belong together, and what to do about those that do not say it themselves."""

    title: str
    otherwise: str
    raised: tuple[str, ...] = ()
    told: tuple[str, ...] = ()


SECTIONS = (
    Section(
        "Details within those sentences",
        "See the table's row in which it stands.",
        told=("daemon/control/fault_detection.py",),
    ),
    Section(
        "An estimate is not valid (`why` in `eit.estimate` and `skin.shear`)",
        "Wait for the next frames; when it stays, tare with nothing gripped, then see `shearloop doctor CONFIG`.",
        told=(
            "daemon/sensing/estimator.py",
            "bank/estimation/fingertip_validator.py",
            "bank/estimation/validity.py",
            "bank/estimation/novelty.py",
            "bank/estimation/imputation.py",
            "daemon/sensing/skin_estimator.py",
            "daemon/sensing/skin_zero.py",
            "drivers/shear_skin/judge.py",
            "daemon/sensing/skin_task.py",
        ),
    ),
    Section(
        "A command is refused, or an experiment ends",
        "Do what the sentence names, then send the command again.",
        raised=("daemon/commands.py", "daemon/control", "daemon/control"),
        told=(
            "daemon/control/control_loop.py",
            "daemon/control/wrist_controller.py",
            "daemon/loop/tune.py",
            "daemon/control/step_runner.py",
            "daemon/messaging/command_server.py",
        ),
    ),
    Section(
        "The robot moves less than it was told, or stops",
        "Begin further inside, or widen the limit in the robot's settings when cell and tool allow it.",
        told=("drivers/ur/limits.py",),
    ),
    Section(
        "The robot cannot be reached or driven",
        "Look at the teach pendant and at the robot's network cable, then `shearloop doctor CONFIG`.",
        raised=("drivers/ur",),
        told=("drivers/ur/error_messages.py",),
    ),
    Section(
        "The gripper",
        "Look at the gripper's lamp and cable; `shearloop command unlock` activates it anew.",
        raised=("drivers/robotiq",),
        told=("drivers/robotiq/faults.py",),
    ),
    Section(
        "Boards and instruments",
        "It is tried again by itself; when it stays, exchange the cable and see `shearloop doctor CONFIG`.",
        raised=(
            "drivers/serial_port.py",
            "drivers/tcp_port.py",
            "drivers/eit_kit.py",
            "drivers/eit_format.py",
            "drivers/hx711.py",
            "drivers/hx711_calibration.py",
            "drivers/calibration_file.py",
            "drivers/shear_skin",
        ),
        told=("drivers/load_cell.py", "drivers/hx711.py", "drivers/shear_skin/adc_board.py"),
    ),
    Section(
        "Configuration, addresses, keys, the service",
        "Mend what the sentence names; `shearloop check CONFIG` says whether it is in order.",
        raised=(
            "daemon/config_file.py",
            "drivers/yaml_file.py",
            "daemon/config.py",
            "daemon/messaging/publisher.py",
            "daemon/messaging/keys.py",
            "daemon/messaging/request.py",
            "daemon/messaging/subscriber.py",
            "daemon/service",
            "daemon/cli/run.py",
            "daemon/cli/connection.py",
            "daemon/cli/keys.py",
            "daemon/cli/emulate.py",
            "daemon/cli/listen.py",
        ),
        told=("daemon/messaging/addresses.py",),
    ),
    Section(
        "Bank files",
        "Copy the file again, or build it anew with `shearloop bank build`.",
        raised=(
            "bank/eit/bank_file.py",
            "bank/eit/build.py",
            "bank/eit/journal.py",
            "bank/eit/matching.py",
            "bank/eit/fast_matching.py",
        ),
    ),
    Section(
        "Fingertips, meshes and models",
        "Mend the geometry or the bank's configuration, then build the bank again.",
        raised=(
            "bank/eit/mesh.py",
            "bank/eit/fingertip.py",
            "bank/eit/forward.py",
            "bank/eit/models.py",
            "daemon/bank_config.py",
            "daemon/cli/bank",
            "daemon/synthetic.py",
        ),
    ),
    Section(
        "Calibrations",
        "Restore the file from a copy, or calibrate again with a longer recording.",
        raised=(
            "bank/eit/calibration.py",
            "bank/estimation",
            "bank/eit/grouping.py",
            "bank/eit/polynomial.py",
            "bank/skin",
            "daemon/sensing/opening.py",
        ),
    ),
    Section(
        "Recordings",
        "Copy or import the recording again.",
        raised=(
            "daemon/recording/matlab_streams.py",
            "daemon/recording/matlab_file.py",
            "daemon/recording",
            "daemon/analysis/reproduce",
            "daemon/cli/evaluate.py",
            "daemon/cli/replay.py",
            "daemon/cli/writing_over.py",
        ),
    ),
)
# What to do about sentences that do not say it themselves, by words of theirs.
CURES = (
    ("which this version does not know", "Use the version that wrote it, or calibrate again."),
    ("was made from slices;", "Calibrate on a recording, `shearloop run --record` or `shearloop import mat`."),
    ("taking the homogeneous frame", "Leave the fingertip untouched until it is taken, some five seconds."),
    ("taking the zero, ", "Leave the skin untouched until it is taken, two seconds."),
    ("sigma have no torque", "Calibrate, and name the file as `calibration`: docs/first-calibration.md."),
    ("zero was refused", "See the reason that follows; take the load off and tare again."),
    ("wires of the gauges are swapped", "Exchange the wires of gauge 1 and gauge 2."),
    ("in compliance", "Follow the two leads from the source to the gauges."),
    ("zero could not be taken", "See the reason that follows, and the skin's task in `shearloop listen health`."),
    ("sigma has no torque", "Calibrate: docs/first-calibration.md."),
    ("the same frame again", "Wait; when it goes on, unplug the board and plug it in again."),
    ("this is another fingertip", "Calibrate this fingertip: docs/first-calibration.md."),
    ("no grip: ", "Grip the tool; when it is gripped, see whether the gel touches it."),
    ("outside of the calibration", "Lower the load; calibrate with such loads when they are meant to be."),
    ("longer than at their zero", "Take the load off and tare the skin."),
    ("shorter than at its zero", "Take the load off and tare the skin."),
    ("is open: its channel", "Follow the two wires of that gauge; measure it with an ohmmeter."),
    ("is shorted, or its sense", "Follow the sense wires of that gauge; look for a bridge."),
    ("beyond the range of its channel", "Choose the next larger range of the DAQ; see that the current is 5 mA."),
    ("sense wires of gauge", "Exchange the two sense wires of that gauge."),
    ("its converter stands still", "Switch the DAQ off and on."),
    ("resistances jumped", "Wait for three readings that agree; look for a loose contact when it comes again."),
    ("is not a measured torque", "Choose one of those for `drive` in the experiment."),
    ("a stop has not been acknowledged", "See to what it names, then `shearloop command unlock`."),
    ("no experiment is running", "Start one: `shearloop command start --experiment FILE`."),
    ("no experiment is paused", "Nothing is to be done: it runs, or there is none."),
    ("wrist turns no faster", "Lower the step's speed, or raise `loop.wrist_speed_rad_per_s`."),
    ("which experiment?", "`shearloop command start --experiment FILE`."),
    ("the wrist did not turn", "See that the robot is in remote control and speed scaling is not 0."),
    ("wrist angle is wrong", "See the sign of the torque sensor's calibration."),
    ("the tool slipped in the grip", "Grip harder, or turn less in `identify`."),
    ("does not settle", "Lower the gain, or ask for wider margins."),
    ("refuses protocol 2", "Update PolyScope."),
)
_REQUIREMENTS = (
    " must ",
    ", expected ",
    ": expected ",
    " needs ",
    " need ",
    " is needed",
    " are needed",
    "there are ",
    "there is no ",
)


def safety_table() -> str:
    """Return the safety table as Markdown."""
    rows = []
    for event, rule in TABLE.items():
        response = RESPONSES[rule.response]
        if rule.hold_at_most_s is not None:
            response += f"; stopped after {rule.hold_at_most_s:g} s"
        rows.append((event.value, response, rule.sentence.format(detail="…").replace("….", "…"), rule.cure))
    return table(("event", "response", "what is said", "what to do"), rows)


def troubleshooting_page(root: Path) -> str:
    """Return the page, from the source below `root`."""
    parts = [_INTRODUCTION, "## The loop holds or stops (`reasons` in `loop.state`)\n\n" + safety_table()]
    listed: set[Sentence] = set()
    for section in SECTIONS:
        rows = [
            (sentence.said, cure_of(sentence, section))
            for sentence in dict.fromkeys(_sentences(section, root))
            if sentence not in listed and not listed.add(sentence)  # type: ignore[func-returns-value]
        ]
        parts.append(f"## {section.title}\n\n{table(('what is said', 'what to do'), rows)}")
    return "\n\n".join(parts) + "\n"


def cure_of(sentence: Sentence, section: Section) -> str:
    """Return what to do: the sentence's own cure, the one for its words, or the section's."""
    if sentence.cure:
        return sentence.cure[0].upper() + sentence.cure[1:] + ("" if sentence.cure.endswith("?") else ".")
    for words, cure in CURES:
        if words in sentence.said:
            return cure
    if any(words in sentence.said for words in _REQUIREMENTS):
        return "Give what the sentence asks for."
    return section.otherwise


_INTRODUCTION = """# When something goes wrong

Written by `make docs` from the code; change the sentences there.

1. `shearloop doctor CONFIG` looks at everything that can be looked at, and names the next step for each.
2. `shearloop listen health` tells of each task whether it is alive, how often it hears its device, and what it refused.
3. `shearloop listen loop.state` tells why the loop is holding.
4. `journalctl -u shearloop -e` is the log of the service.

Below is every sentence that the program may say, and its cure. What stands in ‹angle quotes› is filled in. Search this
page for a few words of what you read."""


def _sentences(section: Section, root: Path) -> Iterator[Sentence]:
    for path in _modules(section.told, root):
        yield from told(path)
    for path in _modules(section.raised, root):
        yield from raised(path)


def _modules(names: Iterable[str], root: Path) -> Iterator[Path]:
    for name in names:
        path = root / name
        yield from [path] if path.is_file() else sorted(path.rglob("*.py"))
