"""What commands print when matplotlib cannot keep its settings in the user's home."""

import os
import subprocess
import sys


def test_a_home_that_cannot_be_written_is_not_remarked_on(tmp_path):
    command = [sys.executable, "-m", "shearloop", "chart", "loop", "--out", str(tmp_path)]
    unwritable = os.environ | {"MPLCONFIGDIR": f"{os.devnull}/none"}
    done = subprocess.run(command, env=unwritable, capture_output=True, text=True, check=True)
    assert done.stderr == ""
    assert (tmp_path / "loop.png").exists()


def test_matplotlib_is_missed_before_anything_is_computed(tmp_path, monkeypatch, mistake):
    monkeypatch.setattr("shearloop.extras.find_spec", lambda _: None)
    (tmp_path / "a.cal").touch()
    out = str(tmp_path / "out")
    for command in (
        ["evaluate", str(tmp_path / "a.cal"), "none.mcap", "--plot"],
        ["chart", "loop", "--out", out],
        ["skin", "characterise", "--out", out],
        ["reproduce", str(tmp_path), "--out", out],
    ):
        assert "needs matplotlib: `" in mistake(*command)
