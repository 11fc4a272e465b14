"""Numbers in the words of a sentence."""


def times(count: int) -> str:
    """Return how often something happened: once, twice, 3 times."""
    return {1: "once", 2: "twice"}.get(count, f"{count} times")


def counted(count: int, one: str, many: str = "") -> str:
    """Return a number with its noun, and the verb if the noun brings one: 1 frame is, 2 frames are."""
    return f"{count} {one if count == 1 else many or f'{one}s'}"
