"""Units: of keys, by the end of their names, and of numbers that were written in another one."""

import math

_UNITS = {"nm": "N·m", "ma": "mA", "deg": "°", "hz": "Hz", "v": "V", "n": "N", "hour": "h", "s2": "s²"}
_UNITS |= {unit: unit for unit in ("m", "cm", "mm", "rad", "s", "kg")}

# What a number may have been written in instead, and how many of the unit it then is.
_DEGREE = math.pi / 180
_MISTAKEN = {
    "rad": ("degrees", _DEGREE),
    "rad/s": ("degrees/s", _DEGREE),
    "rad/s²": ("degrees/s²", _DEGREE),
    "m": ("mm", 1e-3),
    "m/s": ("mm/s", 1e-3),
    "m/s²": ("mm/s²", 1e-3),
    "mm": ("m", 1e3),
    "mm/s": ("m/s", 1e3),
    "kg": ("g", 1e-3),
    "N·m": ("mN·m", 1e-3),
    "s": ("ms", 1e-3),
}
# A number that fits in another power of ten is suspicious only this far outside.
_FAR = 10


def unit_of(key: str) -> str:
    """Return the unit that a key ends with, such as rad/s for `wrist_speed_rad_per_s`, or an empty text."""
    name, _, per = key.partition("_per_")
    units: list[str] = []
    for part in reversed(name.split("_")[1:]):
        if part not in _UNITS:
            break
        units.insert(0, _UNITS[part])
    unit = ", ".join(units)
    return f"{unit or 1}/{_UNITS[per]}" if per in _UNITS else unit


def unit_hint(found: float, unit: str, low: float, high: float) -> str:
    """Return a question where a number outside low … high would fit in another unit, or an empty text."""
    if found == 0 or not math.isfinite(found):
        return ""
    name, factor = _MISTAKEN.get(unit, ("", 0.0))
    if factor == _DEGREE and low <= found * factor <= high:
        return f"did you mean {found * factor:.4g}, {found:g} {name} in {unit}?"
    for power, words, far in (
        (1e-3, "thousandth", abs(found) > _FAR * max(abs(low), abs(high))),
        (1e3, "thousandfold", found < low / _FAR),
    ):
        if far and low <= found * power <= high:
            named = f"{found:g} {name} in {unit}" if power == factor else f"the {words}"
            return f"did you mean {found * power:g}, {named}?"
    return ""
