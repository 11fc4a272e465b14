import os

from shearloop.daemon.process import NICENESS, raise_priority


def test_a_priority_that_is_not_allowed_is_not_raised(monkeypatch):
    asked: list[int] = []

    def refuse(_kind: int, _who: int, niceness: int) -> None:
        asked.append(niceness)
        raise PermissionError

    monkeypatch.setattr(os, "setpriority", refuse)
    raise_priority()
    assert asked == [NICENESS]
