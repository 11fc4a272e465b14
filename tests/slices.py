"""Bytes as they come: in pieces of any size."""

from itertools import pairwise


def slices(data: bytes, cuts: list[int]) -> list[bytes]:
    """Return the data cut at these places, each taken modulo its length."""
    edges = [0, *sorted(cut % (len(data) + 1) for cut in cuts), len(data)]
    return [data[begin:end] for begin, end in pairwise(edges)]
