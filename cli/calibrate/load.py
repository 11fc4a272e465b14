"""`shearloop calibrate load`: measures rest and known masses; refuses a saturated, flat or noisy signal."""

import argparse
import asyncio
import sys
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

from shearloop.cli.calibrations import save_measured
from shearloop.cli.options import add_json, add_option, number
from shearloop.cli.output_paths import output_path, written_to
from shearloop.cli.terminal import Operator, print_result
from shearloop.tools.outputs import YAML_KEYS, check_overwrite

if TYPE_CHECKING:
    from shearloop.drivers.connection import SerialPort
    from shearloop.drivers.load_cell import LoadSample
    from shearloop.drivers.load_cell_calibration import Level

# A board at one reading a second, and its boot loader, are faster.
GIVE_UP_S = 10.0


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `calibrate load`."""
    parser.epilog = (
        "Asks for an empty cell, then for each mass, and measures each for some seconds after you press Enter. Refuses "
        "and repeats a signal that is saturated, flat or noisy. Gives up after "
        f"{GIVE_UP_S:g} s without a reading. Stop the daemon first: it uses the port. Name the file as "
        "`load_cell.calibration` in the configuration."
    )
    port = parser.add_mutually_exclusive_group(required=True)
    port.add_argument("--serial-number", metavar="NUMBER", help="the board's USB serial number")
    add_option(port, "--port", Path, "PATH", "the board's serial port")
    text = "a known mass to put on the cell; give it once per mass: several show whether they agree"
    add_option(parser, "--mass-g", float, "G", text, action="append", required=True)
    text = "from the shaft to the cell (default: %(default)s)"
    add_option(parser, "--lever-arm-mm", number(1.0, 1000.0, unit="mm"), "MM", text, default=35.0)
    text = "the turn that presses on the cell counts as negative torque"
    parser.add_argument("--reverse", action="store_true", help=text)
    add_option(parser, "--out", output_path, "FILE", "the calibration file to write", required=True)
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Measure each load and write the calibration."""
    from shearloop.drivers.connection import SerialPort, find_port
    from shearloop.drivers.load_cell import BAUD_RATE
    from shearloop.drivers.load_cell_calibration import check_masses, fit_levels

    check_overwrite(args.out, "a calibration file", YAML_KEYS)
    replaced = args.out.exists()
    check_masses(args.mass_g)
    with SerialPort(find_port(serial_number=args.serial_number, path=args.port), BAUD_RATE) as port:
        levels = asyncio.run(measure(port, args.mass_g, Operator(stdout_is_for_json=args.json)))
    result = fit_levels(levels, args.lever_arm_mm * 1e-3, -1 if args.reverse else 1)
    save_measured(args.out, result.calibration)
    report = {
        "path": str(args.out),
        "calibration": result.calibration.model_dump(mode="json"),
        "levels": [asdict(level) for level in levels],
        "residual_nm": result.residual_nm,
        "remarks": list(result.sentences),
    }
    return print_result(report, [*result.sentences, written_to(args.out, replaced=replaced)], as_json=args.json)


async def _read_samples(port: "SerialPort", samples: "asyncio.Queue[LoadSample]") -> None:
    """Put every sample into the queue; DeviceLostError after GIVE_UP_S without one."""
    from shearloop.drivers.errors import DeviceLostError
    from shearloop.drivers.load_cell import LoadParser
    from shearloop.drivers.load_cell_calibration import UNCALIBRATED
    from shearloop.drivers.refused_lines import shown

    parser, clock = LoadParser(UNCALIBRATED), asyncio.get_running_loop()
    until_s = clock.time() + GIVE_UP_S
    while (left_s := until_s - clock.time()) > 0:
        if (received := await port.read(left_s)) is None:
            break
        for sample in parser.feed(received.data, received.t_arrival_ns):
            until_s = clock.time() + GIVE_UP_S
            samples.put_nowait(sample)
    nothing = f"no reading came from {port.path} within {GIVE_UP_S:g} s"
    if parser.refusal is not None:
        raise DeviceLostError(f"{nothing}: {parser.refusal.clause}")
    if parser.unfinished:
        raise DeviceLostError(f"{nothing}, only {shown(parser.unfinished)} without a line end; see its program")
    raise DeviceLostError(
        f"{nothing}; check that it is the load cell's board and that the HX711 has power and its DT and SCK wires"
    )


async def measure(port: "SerialPort", masses_g: list[float], operator: Operator) -> list["Level"]:
    """Return the levels of the masses, which the operator hangs on one after the other."""
    from shearloop.drivers.errors import DeviceCalibrationError
    from shearloop.drivers.load_cell_calibration import SAMPLES_PER_STEP, SKIP_SAMPLES, check_levels, measure_level

    samples: asyncio.Queue[LoadSample] = asyncio.Queue()
    levels: list[Level] = []

    async def guide_operator() -> None:
        while len(levels) <= len(masses_g):
            mass_g = masses_g[len(levels) - 1] if levels else 0.0
            await operator.ask(f"{_instruction(mass_g)} Then press Enter.")
            while not samples.empty():
                samples.get_nowait()
            try:
                taken = [await samples.get() for _ in range(SKIP_SAMPLES + SAMPLES_PER_STEP)]
                level = measure_level(taken, mass_g)
                check_levels([*levels, level])
            except DeviceCalibrationError as error:
                print(f"Refused: {error}", file=sys.stderr, flush=True)
            else:
                levels.append(level)
                dropped = f", {level.dropped} corrupted ones left out" if level.dropped else ""
                found = f"{level.mean:.6g}, noise {level.std:.3g}, {level.n} readings{dropped}"
                operator.say(f"  {mass_g:g} g: {found}.")

    with operator:
        # Reading never pauses: bytes in the port's buffer belong to an earlier load.
        tasks = {asyncio.create_task(_read_samples(port, samples)), asyncio.create_task(guide_operator())}
        try:
            done, _ = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        finally:
            for task in tasks:
                task.cancel()
            await asyncio.wait(tasks)
    for task in done:
        task.result()
    return levels


def _instruction(mass_g: float) -> str:
    if not mass_g:
        return "Take every load off the lever arm and let it rest."
    return f"Put {mass_g:g} g on the load cell, where the lever arm presses, and let it hang still."
