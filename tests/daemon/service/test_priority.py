import os

from shearloop.daemon import process


def test_the_sessions_niceness_is_restored(tmp_path, monkeypatch):
    asked: list[int] = []
    group = tmp_path / "autogroup"
    group.write_text("/autogroup-3 nice 2")
    monkeypatch.setattr(process, "AUTOGROUP", group)
    monkeypatch.setattr(os, "setpriority", lambda _kind, _who, niceness: asked.append(niceness))
    with process.high_priority() as allowed:
        assert allowed
        assert group.read_text() == "-10"
    assert group.read_text() == "2"
    assert asked == [-10]


def test_nothing_changes_without_permission(tmp_path, monkeypatch):
    def refuse(_kind: int, _who: int, _niceness: int) -> None:
        raise PermissionError

    monkeypatch.setattr(process, "AUTOGROUP", tmp_path / "absent")
    monkeypatch.setattr(os, "setpriority", refuse)
    with process.high_priority() as allowed:
        assert not allowed
    assert list(tmp_path.iterdir()) == []
