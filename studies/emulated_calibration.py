"""Records the emulated rig and calibrates its fingertips, for `shearloop demo` and for notebooks.

As on a real rig, a recording holds idle frames, a grip, twists with the load cell's torque, and idle frames again, for
several cylinders. It runs on the emulated rig's physics in simulated time, so that a seed always gives the same files:
`rig-DDmm.mcap`, `rig.cal` for both fingertips together, and one calibration for each of them.
"""

import itertools
from collections.abc import Iterable, Iterator
from dataclasses import replace
from importlib import resources
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from numpy.typing import NDArray

from shearloop.bank.build import build_bank
from shearloop.daemon.recorder.schema import DIAMETER_NOTE, EMULATED, LARGEST_DIAMETER_MM
from shearloop.daemon.recorder.writer import McapFile, new_recording
from shearloop.drivers.defaults import FRAME_PERIOD_S
from shearloop.emulators.boards import LOAD_PERIOD_S
from shearloop.emulators.emulated_rig import NOISE_NM, SIDES
from shearloop.emulators.gripper import Gripper, GripperRegisters
from shearloop.emulators.scene import Scene
from shearloop.emulators.synthetic_frames import RigFrames
from shearloop.errors import UserError
from shearloop.estimation import Calibration, FrameSeries, fit, measure_timing
from shearloop.tools.bank_config import load_bank_plan
from shearloop.tools.banks import is_built
from shearloop.tools.estimate_tracks import estimate_series
from shearloop.tools.figures import figures_of
from shearloop.tools.frame_series import series_of
from shearloop.tools.outputs import new_folder, progress_bar, writing
from shearloop.tools.parallel import processors
from shearloop.tools.recordings.frames import read_recording

# Three diameters are enough to interpolate; five halve the interval.
DIAMETERS_MM = (10.0, 17.5, 25.0, 32.5, 40.0)
# Each seed gives other noise and other twists.
SEED = 7
SOURCE = "the emulated rig"
# The time step; about the duration of an injection.
STEP_S = 0.02
IDLE_S, SETTLE_S = 12.0, 10.0
N_TWISTS = 12
# Ranges of the wrist's angles, speeds and holds in a grip.
ANGLES_RAD, SPEEDS_RAD_PER_S, HOLDS_S = (-0.12, 0.25), (0.05, 0.5), (1.0, 15.0)
# Gripper commands: activate, grip a tool with about 60 N, open.
ACTIVATE, GRIP = GripperRegisters(act=True), GripperRegisters(act=True, gto=True, pos=255, spe=128, force=110)
_OPEN = replace(GRIP, pos=0)

Sides = tuple[str, ...]


def lines_of(scene: Scene, frames: RigFrames) -> list[NDArray[np.float64]]:
    """Return the lines of both boards, (v,) in volts, for frames that end now."""
    grip, shear_nm, width_mm = scene.frame(FRAME_PERIOD_S)
    return [frames.line(grip, sign * shear_nm, width_mm) for sign in SIDES.values()]


class TwistPlayer:
    """One scene with a tool, which is recorded from the Unix time 0 on."""

    def __init__(self, frames: RigFrames, diameter_mm: float, seed: int, writer: McapFile) -> None:
        self._writer = writer
        self._random = np.random.default_rng(seed)
        self._frames = frames
        self._gripper = Gripper(object_mm=diameter_mm)
        self._scene = Scene(self._gripper)
        self._wrist_rad = 0.0
        self._due_frame_s, self._due_torque_s = FRAME_PERIOD_S, LOAD_PERIOD_S

    def run(self) -> None:
        """Idle, grip, twist, release."""
        self._gripper.write(ACTIVATE)
        while self._gripper.sta != 3:
            self._step()
        self._hold_still(IDLE_S)
        self._gripper.write(GRIP)
        self._hold_still(SETTLE_S)
        for angle_rad in self._angles():
            self._turn_to(angle_rad, self._random.uniform(*SPEEDS_RAD_PER_S))
            self._hold_still(self._random.uniform(*HOLDS_S))
        self._turn_to(0.0, 0.2)
        self._hold_still(SETTLE_S)
        self._gripper.write(_OPEN)
        self._hold_still(IDLE_S)

    def _angles(self) -> Iterator[float]:
        """Yield angles over the whole range in random order, with a zero after every third."""
        for number, share in enumerate(self._random.permutation(np.linspace(0.0, 1.0, N_TWISTS))):
            yield ANGLES_RAD[0] + float(share) * (ANGLES_RAD[1] - ANGLES_RAD[0])
            if number % 3 == 2:
                yield 0.0

    def _turn_to(self, angle_rad: float, speed_rad_per_s: float) -> None:
        while self._wrist_rad != angle_rad:
            step = np.clip(angle_rad - self._wrist_rad, -speed_rad_per_s * STEP_S, speed_rad_per_s * STEP_S)
            self._wrist_rad = angle_rad if abs(angle_rad - self._wrist_rad) <= abs(step) else self._wrist_rad + step
            self._step()

    def _hold_still(self, seconds: float) -> None:
        for _ in range(round(seconds / STEP_S)):
            self._step()

    def _step(self) -> None:
        self._scene.step(STEP_S, self._wrist_rad)
        now_s = self._scene.time_s
        if now_s >= self._due_frame_s:
            self._due_frame_s += FRAME_PERIOD_S
            middle_ns = round((now_s - FRAME_PERIOD_S / 2) * 1e9)
            for side, line in zip(SIDES, lines_of(self._scene, self._frames), strict=True):
                self._writer.add_frame(side, middle_ns, round(now_s * 1e9), line)
        if now_s >= self._due_torque_s:
            self._due_torque_s += LOAD_PERIOD_S
            torque_nm = self._scene.conversion_nm(LOAD_PERIOD_S) + self._random.normal(0.0, NOISE_NM)
            self._writer.add_torque(round((now_s - LOAD_PERIOD_S / 2) * 1e9), torque_nm)


def calibrate(recordings: list[FrameSeries], sides: Sides) -> Calibration:
    """Return the default estimator's calibration for these fingertips."""
    chosen = [recording.select_sides(sides) for recording in recordings]
    return fit("motion_regression", chosen, SOURCE, timing=measure_timing(chosen, recordings))


def write_recordings(bank: Path, folder: Path, diameters_mm: tuple[float, ...], seed: int) -> Iterator[Path]:
    """Write the recording of each cylinder, and yield its path."""
    frames = RigFrames(bank, seed)
    for number, diameter_mm in enumerate(diameters_mm):
        path = folder / _name_of(diameter_mm)
        notes = {DIAMETER_NOTE: f"{diameter_mm:g}", EMULATED: "every device"}
        with new_recording(path, SOURCE, notes, frames.table) as writer:
            TwistPlayer(frames, diameter_mm, seed + number, writer).run()
        yield path


def _name_of(diameter_mm: float) -> str:
    """Return the name of the recording of a cylinder."""
    return f"rig-{diameter_mm:g}mm.mcap"


def record(bank: Path, seed: int, diameters_mm: tuple[float, ...] = DIAMETERS_MM) -> Iterator[FrameSeries]:
    """Yield the recording of each cylinder, which is not kept."""
    with TemporaryDirectory() as folder:
        for path in write_recordings(bank, Path(folder), diameters_mm, seed):
            yield series_of(read_recording(path))


def emulate_recordings(
    folder: str | Path, diameters_mm: float | Iterable[float] = DIAMETERS_MM, seed: int = SEED
) -> list[Path]:
    """Record twists of the emulated rig, a file for each tool, and return the files; the same seed gives the same ones.

    The folder also gets `demo.bank`, the bank that the frames are made of. Raises UserError for a diameter that no tool
    has, and where the folder cannot be written.
    """
    folder = Path(folder)
    tools_mm = tuple(diameters_mm) if isinstance(diameters_mm, Iterable) else (diameters_mm,)
    for number, tool_mm in enumerate(tools_mm):
        if not 0 < tool_mm < LARGEST_DIAMETER_MM:
            raise UserError(f"diameters_mm has {tool_mm:g}; give numbers above 0 and below {LARGEST_DIAMETER_MM:g}")
        if _name_of(tool_mm) in map(_name_of, tools_mm[:number]):
            raise UserError(f"diameters_mm has {tool_mm:g} twice, and both have one file; give each diameter once")
    bank = folder / "demo.bank"
    with resources.as_file(resources.files("shearloop") / "config") as config:
        plan = load_bank_plan(config / "banks" / "demo.yaml")
    with writing(folder, "the folder"), new_folder(folder):
        if not is_built(bank, plan.definition):
            build_bank(*plan, bank, jobs=processors())
        return list(write_recordings(bank, folder, tools_mm, seed))


def calibrate_rig(bank: Path, folder: Path) -> None:
    """Record and calibrate into a folder, and print the calibrations' accuracy on a separate recording."""
    recordings = []
    with progress_bar("recordings", len(DIAMETERS_MM), "cylinder") as show:
        for number, path in enumerate(write_recordings(bank, folder, DIAMETERS_MM, SEED), 1):
            recordings.append(series_of(read_recording(path)))
            show(number)
    apart = list(record(bank, SEED + 100, (20.0,)))
    both: Sides = tuple(SIDES)
    for sides in itertools.chain([both], ((side,) for side in both)):
        calibration = calibrate(recordings, sides)
        path = folder / ("rig.cal" if sides == both else f"rig-{sides[0]}.cal")
        calibration.save(path)
        figures = figures_of([estimate_series(calibration, recording) for recording in apart])
        print(
            f"{path}: root mean square errors {figures['rmse_nm']:.4f} N·m and {figures['diameter_rmse_mm']:.1f} mm; "
            f"{figures['valid_fraction']:.0%} of frames have a torque, "
            f"{figures['coverage_95']:.0%} of torques lie within their 95 % intervals"
        )
