"""The errors of libraries that are not installed."""

import re

import pytest

from shearloop.drivers.ur.library import missing_library, why_other_client
from shearloop.extras import missing


@pytest.fixture(autouse=True)
def python_in_a_folder_with_a_blank(monkeypatch):
    monkeypatch.setattr("sys.executable", "/home/ada/my env/bin/python")


def test_the_command_that_installs_a_library_can_be_copied(monkeypatch):
    monkeypatch.setattr("shearloop.drivers.ur.library.version", lambda _name: "1.7.0")
    monkeypatch.setattr("shearloop.drivers.ur.library.find_spec", lambda _name: None)
    for said in (str(missing("matplotlib", "plot", "a chart")), why_other_client(), missing_library()):
        assert re.search(r"'/home/ada/my env/bin/python' -m pip install \S", said)
