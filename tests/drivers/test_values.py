"""Values are equal, hashed and replaced as frozen dataclasses are."""

from dataclasses import FrozenInstanceError, dataclass, replace
from typing import Any

import pytest


@dataclass(frozen=True, slots=True)
class Pair:
    one: int
    other: str = ""


def test_a_value_is_what_a_frozen_dataclass_is_to_who_reads_it() -> None:
    assert Pair(1, "a") == replace(Pair(2, "a"), one=1) != Pair(2, "a")
    assert {Pair(1): "first"}[Pair(1)] == "first"
    assert not hasattr(Pair(1), "__dict__")


def test_a_value_has_no_guard_when_it_runs() -> None:
    """The guard is what it is without; should a later Python make it cheap, `dataclass` will do."""

    @dataclass(frozen=True, slots=True)
    class Guarded:
        one: int

    guarded: Any = Guarded(1)
    with pytest.raises(FrozenInstanceError):
        guarded.one = 2
    unguarded: Any = Pair(1)
    unguarded.one = 2
    assert unguarded == Pair(2)


@pytest.mark.parametrize("asked", [{"frozen": False, "slots": True}, {"frozen": True, "slots": False}])
def test_what_is_not_to_be_a_value_is_refused(asked: dict[str, bool]) -> None:
    decorate: Any = value
    with pytest.raises(TypeError, match="a value is frozen"):
        decorate(**asked)
