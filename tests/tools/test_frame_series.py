"""Recordings that hold the same frames are not two measurements."""

import numpy as np
import pytest

from shearloop.errors import UserError
from shearloop.tools.frame_series import check_no_copies
from tests.estimation.conftest import kept, twisting


def test_a_copy_that_lacks_frames_is_a_copy():
    whole = twisting(cycles=1)
    lost = np.ones(len(whole.t_s), dtype=np.bool_)
    lost[[3, 60]] = False
    n = len(whole.t_s)
    for named, said in (
        ([("a", whole), ("b", kept(whole, lost))], f"{n - 2} of {n - 2} frames of b are in a too; give one of the two"),
        ([("b", kept(whole, lost)), ("a", whole)], f"{n - 2} of {n} frames of a are in b too; give one of the two"),
        ([("a", whole), ("b", whole)], f"{n} of {n} frames of b are in a too"),
    ):
        with pytest.raises(UserError, match=said):
            check_no_copies(named)


def test_parts_and_common_idle_frames_are_no_copies():
    whole = twisting(cycles=1)
    n = len(whole.t_s)
    check_no_copies([("a", whole.between(0, 80)), ("b", whole.between(80, n)), ("c", twisting(cycles=1, seed=2))])
    check_no_copies([("a", whole.between(0, 80)), ("b", whole.between(50, n))])
