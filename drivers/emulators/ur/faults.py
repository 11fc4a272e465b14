"""What can go wrong with the controller, by lines of text."""

from collections.abc import Callable

from shearloop.drivers.emulators.ur.server import Controller


def obey(controller: Controller, line: str) -> None:
    """Carry one fault out.

    Raises:
        ValueError: the line is no fault; the message says which there are.
    """
    name, *arguments = line.split()
    act = FAULTS.get(name)
    if act is None:
        raise ValueError(f"there is no fault {name!r}; there are {', '.join(FAULTS)}")
    try:
        act(controller, arguments)
    except (ValueError, IndexError):
        raise ValueError(f"{name} does not take {' '.join(arguments) or 'nothing'}") from None


def _registers_in_use(controller: Controller, arguments: list[str]) -> None:
    controller.robot.registers_taken = _on(arguments)


def _local_control(controller: Controller, arguments: list[str]) -> None:
    controller.robot.remote_control = not _on(arguments)


def _refuse_protocol(controller: Controller, arguments: list[str]) -> None:
    controller.protocol_refused = _on(arguments)


def _stop_hangs(controller: Controller, arguments: list[str]) -> None:
    controller.stop_hangs = int(arguments[0])


def _normal(controller: Controller, _arguments: list[str]) -> None:
    controller.robot.clear_faults()
    controller.protocol_refused = False
    controller.stop_hangs = 0
    controller.silence(0.0)


def _on(arguments: list[str]) -> bool:
    return {"on": True, "off": False}.get(arguments[0] if arguments else "on", True)


FAULTS: dict[str, Callable[[Controller, list[str]], None]] = {
    "protective-stop": lambda controller, _: controller.robot.protective_stop("asked for by hand"),
    "emergency-stop": lambda controller, _: controller.robot.emergency_stop(),
    "release": lambda controller, _: controller.robot.release(),
    "drop-rtde": lambda controller, _: controller.drop_rtde(),
    "silence": lambda controller, arguments: controller.silence(float(arguments[0])),
    "stop-hangs": _stop_hangs,
    "registers-in-use": _registers_in_use,
    "local-control": _local_control,
    "refuse-protocol": _refuse_protocol,
    "normal": _normal,
}
