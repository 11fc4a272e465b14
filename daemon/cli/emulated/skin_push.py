"""The skin behind the emulated instruments, and what it is told on standard input."""

import math
import time

from shearloop.daemon.synthetic_skin import SyntheticSkin, SyntheticSkinSettings

# How often a swept force goes there and back.
SWEEP_PERIOD_S = 20.0
# Time is let pass in steps of this.
REST_S = 1.0


class PushedSkin:
    """A skin whose gauges are read now and then; time passes for it in between."""

    def __init__(self, seed: int = 0, sweep_n: float = 0.0, settings: SyntheticSkinSettings | None = None) -> None:
        self.skin = SyntheticSkin(settings, seed=seed)
        self._sweep_n = sweep_n
        self._began_s = self._rested_s = time.monotonic()
        self._angle_rad: float | None = None

    def resistances_ohm(self) -> tuple[float, float]:
        """Return R₁ and R₂ as they are now."""
        now_s = time.monotonic()
        if now_s - self._rested_s >= REST_S:
            self.skin.rest(now_s - self._rested_s)
            self._rested_s = now_s
        if self._sweep_n:
            self.skin.push(self._sweep_n * math.sin(2.0 * math.pi * (now_s - self._began_s) / SWEEP_PERIOD_S))
        return self.skin.resistances_ohm()

    def turned(self, angle_rad: float) -> float:
        """Let the tool follow the wrist, counted from where it is first; return the torque that the flange feels."""
        if self._angle_rad is None:
            self._angle_rad = angle_rad
        self.skin.turn(angle_rad - self._angle_rad)
        return -self.skin.torque_nm

    def gripped(self, torque_nm: float, *, gripped: bool, lever_m: float) -> None:
        """Let a gripped tool shear the skin by its torque at a lever; nothing touches it while none is gripped."""
        self.skin.normal_n = self.skin.settings.normal_n if gripped else 0.0
        self.skin.push(torque_nm / lever_m if gripped else 0.0)

    def told(self, line: str) -> bool:
        """Take a line that pushes the skin; return whether it did. ValueError, with a sentence, for a bad number."""
        match line.split():
            case ["shear", newtons]:
                self.skin.push(_newtons(newtons))
            case ["normal", newtons]:
                self.skin.normal_n = abs(_newtons(newtons))
                self.skin.push(self.skin.shear_n)
            case _:
                return False
        self._sweep_n = 0.0
        return True


def _newtons(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = float("nan")
    if not abs(value) <= 20.0:
        raise ValueError(f"{text!r} is no force of at most 20 N; write for instance 0.5")
    return value
