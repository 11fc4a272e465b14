"""`shearloop calibrate load`: rest, then known masses; refuses a signal that is saturated, flat or noisy."""

import argparse
import asyncio
import sys
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

from shearloop.daemon.cli.operator_input import Operator
from shearloop.daemon.cli.options import add_json
from shearloop.daemon.cli.output import print_result

if TYPE_CHECKING:
    from shearloop.drivers.hx711_calibration import LoadCalibrator
    from shearloop.drivers.serial_port import SerialPort


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `calibrate load`."""
    parser.epilog = (
        "It asks for an empty cell, then for each mass in turn, and measures each for some seconds once you press "
        "Enter. A signal that is saturated, flat or noisy is refused, and asked for again. No daemon may be using the "
        "port meanwhile. Name the file as `load_cell.calibration` in the configuration."
    )
    port = parser.add_mutually_exclusive_group(required=True)
    port.add_argument("--serial-number", metavar="NUMBER", help="the board's USB serial number")
    port.add_argument("--port", metavar="PATH", help="the board's serial port")
    parser.add_argument(
        "--mass-g",
        type=float,
        action="append",
        required=True,
        metavar="G",
        help="a known mass to put on the cell; give it once per mass: several show whether they agree",
    )
    parser.add_argument(
        "--lever-arm-mm",
        type=float,
        default=35.0,
        metavar="MM",
        help="from the shaft to the cell (default: %(default)s)",
    )
    parser.add_argument(
        "--reverse", action="store_true", help="the turn that presses on the cell counts as negative torque"
    )
    parser.add_argument("--out", type=Path, required=True, metavar="FILE", help="the calibration file to write")
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Ask for each load, measure it, and write the calibration."""
    from shearloop.daemon.cli.options import check_overwrite
    from shearloop.daemon.errors import UserError
    from shearloop.drivers.calibration_file import save_calibration
    from shearloop.drivers.hx711 import BAUD_RATE
    from shearloop.drivers.hx711_calibration import LoadCalibrator
    from shearloop.drivers.serial_port import SerialPort, find_port

    if not 0 < args.lever_arm_mm < 1000:
        raise UserError(f"--lever-arm-mm {args.lever_arm_mm:g} is no lever arm; give millimetres above 0")
    if not args.out.parent.is_dir():
        raise UserError(f"--out {args.out} cannot be written: the folder {args.out.parent} does not exist")
    check_overwrite(args.out, "a calibration file")
    calibrator = LoadCalibrator(args.mass_g, args.lever_arm_mm * 1e-3, -1 if args.reverse else 1)
    with SerialPort(find_port(serial_number=args.serial_number, path=args.port), BAUD_RATE) as port:
        asyncio.run(_measure(port, calibrator, Operator(stdout_is_for_json=args.json)))
    result = calibrator.result()
    save_calibration(args.out, result.calibration)
    told = {
        "path": str(args.out),
        "calibration": result.calibration.model_dump(mode="json"),
        "levels": [asdict(level) for level in result.levels],
        "residual_nm": result.residual_nm,
        "remarks": list(result.sentences),
    }
    print_result(told, [*result.sentences, f"Written to {args.out}."], as_json=args.json)
    return 0


async def _measure(port: "SerialPort", calibrator: "LoadCalibrator", operator: Operator) -> None:
    async with operator:
        session = _Session(port, calibrator, operator)
        # The port is read all the while: what waits in its buffer was measured under an earlier load.
        tasks = {asyncio.create_task(session.listen()), asyncio.create_task(session.lead())}
        try:
            done, _ = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        finally:
            for task in tasks:
                task.cancel()
            await asyncio.wait(tasks)
    for task in done:
        task.result()


class _Session:
    def __init__(self, port: "SerialPort", calibrator: "LoadCalibrator", operator: Operator) -> None:
        self._port = port
        self._calibrator = calibrator
        self._operator = operator
        self._step: asyncio.Future[None] | None = None

    async def listen(self) -> None:
        from shearloop.drivers.calibration_file import CalibrationError
        from shearloop.drivers.errors import DeviceLostError
        from shearloop.drivers.hx711 import LoadParser
        from shearloop.drivers.hx711_calibration import UNCALIBRATED
        from shearloop.drivers.streaming_sensor import BOOT_S

        parser = LoadParser(UNCALIBRATED)
        while (received := await self._port.read(BOOT_S)) is not None:
            for sample in parser.feed(received.data, received.t_arrival_ns):
                try:
                    complete = self._calibrator.feed(sample)
                except CalibrationError as error:
                    self._end_step(error)
                else:
                    if complete:
                        self._end_step(None)
        raise DeviceLostError(
            f"{self._port.path} has sent nothing for {BOOT_S:g} s; "
            "check that it is the load cell's board and that the HX711 has power and its DT and SCK wires"
        )

    def _end_step(self, error: Exception | None) -> None:
        if self._step is None or self._step.done():
            return
        if error is None:
            self._step.set_result(None)
        else:
            self._step.set_exception(error)

    async def lead(self) -> None:
        from shearloop.drivers.calibration_file import CalibrationError

        while not self._calibrator.finished:
            await self._operator.ask(f"{self._calibrator.prompt} Then press Enter.")
            self._step = asyncio.get_running_loop().create_future()
            self._calibrator.ready()
            try:
                await self._step
            except CalibrationError as error:
                print(f"Refused: {error}", file=sys.stderr, flush=True)
            else:
                level = self._calibrator.levels[-1]
                read = f"{level.mean:.6g}, noise {level.std:.3g}, {level.n} readings"
                self._operator.say(f"  {level.mass_g:g} g: {read}.")
