"""What compiled calls know of fingertips: they are made once, of arrays that fit together."""

import numpy as np
import pytest

from shearloop.bank.eit import compiled
from shearloop.bank.eit.channels import N_CHANNELS

pytestmark = pytest.mark.skipif(not compiled.IS_COMPILED, reason="nothing is compiled")

LIMITS = (9, 224, 0.12, 0.6, 0.01)


@pytest.fixture
def parts() -> dict[str, np.ndarray]:
    """What two fingertips with one direction are made of, in order."""
    rows, mask = np.ones((2, N_CHANNELS)), np.ones((2, N_CHANNELS), dtype=np.bool_)
    moves = np.zeros((2, 3, N_CHANNELS))
    return {
        "known": np.ones((2, 2, N_CHANNELS)), "jumps_v": rows, "weights": rows, "directions": rows[:, None],
        "reads": moves, "shapes": moves, "counts": np.full(4, N_CHANNELS), "told": mask, "lost": ~mask,
    }  # fmt: skip


def test_fingertips_that_do_not_fit_together_are_refused(parts) -> None:
    made = compiled.frames.Fingertips(2, 1, 3, tuple(parts.values()), *LIMITS)
    with pytest.raises(TypeError, match="made once"):
        made.__init__(2, 1, 3, tuple(parts.values()), *LIMITS)
    for name, one in parts.items():
        other = {"counts": np.int32, "told": np.uint8, "lost": np.int8}.get(name, np.float32)
        for wrong in (
            one[:1],
            one.repeat(2, axis=-1)[..., ::2],
            one.astype(other),
            one.astype(one.dtype.newbyteorder()),
        ):
            if wrong.dtype == one.dtype and wrong.shape == one.shape and wrong.flags.c_contiguous:
                # A byte has no order.
                continue
            with pytest.raises(ValueError, match="does not fit together, or is of another kind"):
                compiled.frames.Fingertips(2, 1, 3, tuple((parts | {name: wrong}).values()), *LIMITS)
    for arrays in ((), tuple(parts.values())[:-1], (*parts.values(), parts["lost"])):
        with pytest.raises(TypeError, match=f"{len(arrays)} arguments instead of 9"):
            compiled.frames.Fingertips(2, 1, 3, arrays, *LIMITS)
    for m, p, q in ((0, 1, 3), (-1, 1, 3), (2, -1, 3), (2**40, 1, 3), (2, 2**60, 3), (2, 1, -1), (2, 1, 2**60)):
        with pytest.raises(ValueError, match="fingertips with"):
            compiled.frames.Fingertips(m, p, q, tuple(parts.values()), *LIMITS)
    empty = compiled.frames.Fingertips.__new__(compiled.frames.Fingertips)
    for call in (empty.check, empty.fill_in, empty.placed):
        with pytest.raises(ValueError, match="no fingertips"):
            call(*[parts["weights"]] * 4)


def test_fingertips_whose_arguments_make_them_stay_as_they_were_made(parts) -> None:
    """A number that makes them while it is read for another making: what was made is kept, and its size with it."""
    made = compiled.frames.Fingertips.__new__(compiled.frames.Fingertips)
    arrays = tuple(parts.values())

    class Meddling:
        def __index__(self) -> int:
            made.__init__(2, 1, 3, arrays, *LIMITS)
            return 1000

    with pytest.raises(TypeError, match="made once"):
        made.__init__(2, Meddling(), 3, arrays, *LIMITS)
    frame = np.random.default_rng(0).uniform(0.95, 1.05, (2, N_CHANNELS))
    assert made.check(frame, parts["told"], parts["lost"], frame) == [0, 0]
    with pytest.raises(TypeError, match="2 arguments instead of 4"):
        made.check(frame, parts["told"])
    with pytest.raises(ValueError, match=r"are \(m, 896\) float64 values"):
        made.fill_in(frame[:1], frame)
