"""Numbers in the commands of emulated devices."""


def number_between(text: str, low: float, high: float, otherwise: str) -> float:
    """Return a command's number; ValueError, `text` and `otherwise`, unless it lies from low to high."""
    try:
        value = float(text)
    except ValueError:
        value = float("nan")
    if not low <= value <= high:
        raise ValueError(f"{text!r} is {otherwise}")
    return value
