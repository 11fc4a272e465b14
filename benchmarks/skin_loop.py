"""The loop that holds a shear force through hysteresis and deadband: how wide is what is left of an oscillation?

`python -m benchmarks.skin_loop --out DIR` lets the daemon's own loop (brain, identification, controller, estimator)
drive
the emulated skin in virtual time: 1 N is loaded, unloaded to 0.6 N and loaded again, each held for 20 s. What it
tells: the width of the true force (peak to peak) over the last 12 s of each hold, against 2 μFₙ, the width of the
friction's own band; and how far from the set point it is held. Over gains and over delays, with normal forces, with
and without the controller's deadband, with a normal force that is not the one configured, with a loop that is given a
number where friction leaves a band, and with an estimator that knows nothing of friction: the worst of several noises
each. Numbers go to `skin_loop.json`, the chart to `skin_loop.png` and `.svg`; `shearloop chart stability` draws the
same as `stability-skin`.
"""

import argparse
from pathlib import Path

from benchmarks.held_shear import Held
from shearloop.daemon.analysis.charts.limit_cycle import chart
from shearloop.daemon.workers import SerialExecutor


def main() -> None:
    """Measure, write, draw, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("run/bench"))
    chart(parser.parse_args().out, SerialExecutor(), "skin_loop", told=_told)


def _told(held: Held) -> None:
    case = held.case
    print(
        f"{case.name:34} kp {case.kp:4.2f}  age {case.age_s:4.2f} s   width {held.width_n:.4f} N of "
        f"{held.bound_n:.2f} allowed   offset {held.offset_n:.4f} N   {held.phase}",
        flush=True,
    )


if __name__ == "__main__":
    main()
