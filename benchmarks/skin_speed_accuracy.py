"""Shear skin, speed against accuracy: closed form, membrane and three meshes against the converged 2-D solution.

`python -m benchmarks.skin_speed_accuracy --out DIR` follows one loading to 1 N and one whole hysteresis loop between
±1 N
under 1 N of normal force, writes `skin_speed_accuracy.json` and draws the chart. Errors are the largest difference
of response, relative to the largest response. Times are the best of several runs per load step; the 2-D models pay
their mesh once beforehand, which is given apart. The reference itself is converged to a few parts in 10⁵ (its response
to 1 N moves by 2.3e-5 on four times its elements); differences below that mean nothing.
"""

import argparse
import json
import platform
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path

import numpy as np

from shearloop.bank.arrays import FloatArray
from shearloop.bank.skin import closed_form
from shearloop.bank.skin.annulus import MESH_56, MESH_112, MESH_448, MESH_1792, CondensedSkin, MeshSize, condense
from shearloop.bank.skin.contact import follow, gauge_strains
from shearloop.bank.skin.gauge import response_of_strains
from shearloop.bank.skin.membrane import paper_membrane, section_membrane
from shearloop.bank.skin.section import PAPER_SECTION
from shearloop.bank.skin.synthetic import loading, loop, responses

NORMAL_N, AMPLITUDE_N = 1.0, 1.0
UP, LOOP = loading(AMPLITUDE_N), loop(AMPLITUDE_N)


@dataclass(frozen=True, slots=True)
class Measured:
    """One model: seconds per load step, seconds of preparation, and errors relative to the largest response."""

    model: str
    step_s: float
    prepare_s: float
    loading_error: float
    loop_error: float


def _best_s(action: Callable[[], object], repeats: int) -> float:
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        action()
        times.append(time.perf_counter() - start)
    return min(times)


def _two_d(skin: CondensedSkin, path: FloatArray) -> FloatArray:
    return response_of_strains(*gauge_strains(skin, follow(skin, NORMAL_N, path.tolist())).T)


def _closed(path: FloatArray) -> FloatArray:
    return np.array([closed_form.loading_response(PAPER_SECTION, NORMAL_N, shear) for shear in path.tolist()])


def measure(
    meshes: tuple[MeshSize, ...] = (MESH_56, MESH_112, MESH_448), reference: MeshSize = MESH_1792
) -> list[Measured]:
    """Return every model's time and error against the 2-D solution on the reference mesh."""
    reference_skin = condense(PAPER_SECTION, reference)
    truth_up, truth_loop = _two_d(reference_skin, UP), _two_d(reference_skin, LOOP)
    scale = abs(truth_loop).max()

    def against_truth(name: str, model: Callable[[FloatArray], FloatArray], prepare_s: float, repeats: int) -> Measured:
        return Measured(
            model=name,
            step_s=_best_s(lambda: model(LOOP), repeats) / len(LOOP),
            prepare_s=prepare_s,
            loading_error=float(abs(model(UP) - truth_up).max() / scale),
            loop_error=float(abs(model(LOOP) - truth_loop).max() / scale),
        )

    found = [against_truth("closed form", _closed, 0.0, 50)]
    for name, membrane in (("1-D, paper's F/(EA)", paper_membrane()), ("1-D, section's EA", section_membrane())):
        found.append(against_truth(name, partial(responses, membrane, normal_n=NORMAL_N), 0.0, 50))
    for mesh in meshes:
        prepare_s = _best_s(partial(condense, PAPER_SECTION, mesh), 2)
        skin = condense(PAPER_SECTION, mesh)
        found.append(against_truth(f"2-D, {mesh.elements} elements", partial(_two_d, skin), prepare_s, 3))
    return found


def draw(found: list[Measured], out: Path) -> None:
    """Draw error against time, loading and loop joined for each model."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.5, 4.8), layout="constrained")
    axes = figure.add_subplot(xscale="log", yscale="log")
    for one in found:
        times, errors = [1e6 * one.step_s] * 2, [one.loading_error, one.loop_error]
        (line,) = axes.plot(times, errors, lw=1)
        axes.plot(times[0], errors[0], "o", color=line.get_color())
        axes.plot(times[1], errors[1], "s", color=line.get_color(), label=one.model)
    axes.plot([], [], "o", color="grey", label="loading from zero")
    axes.plot([], [], "s", color="grey", label="whole hysteresis loop")
    axes.set(
        title=f"Shear skin: time against error to the converged 2-D solution, Fn = {NORMAL_N} N",
        xlabel="time per load step, µs",
        ylabel="largest error / largest response",
    )
    axes.grid(alpha=0.25, which="both")
    axes.legend(fontsize=8)
    for suffix in ("png", "svg"):
        figure.savefig(out / f"skin_speed_accuracy.{suffix}", dpi=150)


def main() -> None:
    """Measure, write, draw, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("run/bench"))
    out: Path = parser.parse_args().out
    out.mkdir(parents=True, exist_ok=True)
    found = measure()
    document = {
        "machine": platform.processor() or platform.machine(),
        "normal_n": NORMAL_N,
        "amplitude_n": AMPLITUDE_N,
        "reference": f"2-D, {MESH_1792.elements} elements",
        "models": [asdict(one) for one in found],
    }
    (out / "skin_speed_accuracy.json").write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")
    draw(found, out)
    for one in found:
        ratio = one.step_s / found[1].step_s
        print(
            f"{one.model:22} {1e6 * one.step_s:10.1f} µs/step ({ratio:7.1f} × 1-D)  {1e3 * one.prepare_s:8.1f} ms "
            f"before   loading {100 * one.loading_error:8.4f} %   loop {100 * one.loop_error:8.4f} %"
        )


if __name__ == "__main__":
    main()
