"""Connecting, with a client of the test's own in place of ur-rtde."""

import ctypes
import importlib
import sys
from collections.abc import Iterator
from types import ModuleType, SimpleNamespace

import pytest

from tests.drivers.ur.flight import SETTINGS


class Client:
    """Connects to nothing."""

    FLAG_NO_WAIT = 0

    def __init__(self, *_: object) -> None:
        self.connected = True


@pytest.fixture
def arm(monkeypatch: pytest.MonkeyPatch) -> Iterator[ModuleType]:
    """The module `drivers.ur.arm` over such clients."""
    for name, kinds in (
        ("rtde_control", ["RTDEControlInterface"]),
        ("dashboard_client", ["DashboardClient"]),
    ):
        module = ModuleType(name)
        for kind in kinds:
            setattr(module, kind, Client)
        monkeypatch.setitem(sys.modules, name, module)
    arm = importlib.import_module("drivers.ur.arm")
    monkeypatch.setattr(arm, "Receiver", Client)
    yield arm
    del sys.modules["drivers.ur.arm"]


def test_kernel_that_does_not_let_threads_be_woken_late_does_not_prevent_connecting(
    arm: ModuleType, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(ctypes, "CDLL", lambda *_, **__: SimpleNamespace(prctl=lambda *_: -1))
    assert arm.Arm(SETTINGS)._control.connected
    assert "woken more often than needed" in capsys.readouterr().err
