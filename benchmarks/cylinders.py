"""How exact a diameter is over the number of cylinders calibrated on: `python -m benchmarks.cylinders --bank
run/demo.bank`.

The emulated rig is calibrated on three to seven cylinders, each gripped once, and judged on other recordings of tools
that were not among them. With `--recordings` each of the paper's four cylinders is read by a line through the other
three; what a grip is, is learned from all four, for three do not know the fourth one's. Prints tables.
"""

import argparse
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.across_recordings import DIAMETERS_MM, imported
from benchmarks.rig_twists import calibrate, record
from shearloop.bank.estimation import Calibration, FrameSeries, TactileFrame, fit
from shearloop.bank.estimation.cylinders import Gripped, fit_line
from shearloop.bank.estimation.session_state import SessionState
from shearloop.daemon.analysis.evaluation import follow, judge
from shearloop.drivers.emulators.rig import SIDES

SETS_MM = (
    (10.0, 25.0, 40.0),
    (10.0, 20.0, 30.0, 40.0),
    (10.0, 17.5, 25.0, 32.5, 40.0),
    (10.0, 15.0, 20.0, 25.0, 30.0, 35.0, 40.0),
)
TOOLS_MM = (12.0, 18.0, 22.0, 28.0, 38.0)


def recorded(bank: Path, seed: int, diameters_mm: tuple[float, ...]) -> list[FrameSeries]:
    """Return what is recorded of the emulated rig with each tool."""
    return [one.series(mm) for mm, one in record(bank, seed, diameters_mm)]


def on_the_rig(bank: Path, seed: int, calibrations: int) -> None:
    """Print how exact calibrations on sets of cylinders are."""
    tools = recorded(bank, seed, TOOLS_MM)
    print("| cylinders | sides | RMSE in mm | coverage | largest half width in mm |\n|---|---|---|---|---|")
    for number, cylinders_mm in enumerate(SETS_MM):
        seeds = [seed + 1000 * (1 + number) + 100 * i for i in range(calibrations)]
        known = [recorded(bank, one, cylinders_mm) for one in seeds]
        for sides in (tuple(SIDES), *((side,) for side in SIDES)):
            fitted = [calibrate(one, sides) for one in known]
            figures = judge([follow(one, tool) for one in fitted for tool in tools])
            halves = [one.diameter.reader.intervals.half_widths[0] for one in fitted if one.diameter is not None]
            print(
                f"| {len(cylinders_mm)} | {' and '.join(sides)} | {figures['diameter_rmse_mm']:.1f} | "
                f"{figures['diameter_coverage_95']:.2f} | {max(halves):.1f} |",
                flush=True,
            )


def on_recordings(folder: Path, scratch: Path) -> None:
    """Print how each of the paper's cylinders is read by a line through the others."""
    streams = [
        imported(sorted((folder / "streams" / "cylinders").glob(f"{mm}mm_*.mat")), scratch / f"{mm}mm.mcap")
        for mm in DIAMETERS_MM
    ]
    calibration = fit("fused", streams, "all cylinders")
    grips = [gripped(calibration, one) for one in streams]
    print("\n| recorded cylinder in mm | read by a line through the others | RMSE in mm |\n|---|---|---|")
    for one in grips:
        found = fit_line([other for other in grips if other is not one]).predict(one.held)
        rmse = float(np.sqrt(((found - one.diameter_mm) ** 2).mean()))
        print(f"| {one.diameter_mm:g} | {found.mean():.1f} | {rmse:.1f} |")


def gripped(calibration: Calibration, series: FrameSeries) -> Gripped:
    """Return what a recording's frames that nothing speaks against say of its tool."""
    memory = SessionState(calibration.guards, calibration.motion)
    places: list[NDArray[np.float64]] = []
    held: list[NDArray[np.float64]] = []
    for t_s, channels in zip(series.t_s, series.channels, strict=True):
        moment = memory.see(TactileFrame.of(float(t_s), channels))
        if not moment.why:
            places.append((moment.difference / calibration.scale).ravel())
            held.append((memory.held / calibration.scale).ravel())
    return Gripped(float(series.diameter_mm[0]), np.array(places), np.array(held))


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--bank", type=Path, required=True, help="the bank that the emulated rig's frames are made of")
    parser.add_argument("--recordings", type=Path, help="folder with streams/cylinders")
    parser.add_argument("--out", type=Path, default=Path("build/cylinders"))
    parser.add_argument("--seed", type=int, default=5000)
    parser.add_argument("--calibrations", type=int, default=4, help="of each set of cylinders")
    args = parser.parse_args()
    on_the_rig(args.bank, args.seed, args.calibrations)
    if args.recordings:
        args.out.mkdir(parents=True, exist_ok=True)
        on_recordings(args.recordings, args.out)


if __name__ == "__main__":
    main()
