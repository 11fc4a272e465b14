"""The unit under a real systemd: the first process of namespaces of its own, where the service is installed and run."""

import contextlib
import os
import shutil
import subprocess
import sys
import sysconfig
from pathlib import Path

import pytest
import yaml

HERE = Path(__file__).parent
SYSTEMD = Path("/lib/systemd/systemd")
NAMESPACES = ["unshare", "--pid", "--kill-child", "--fork", "--mount", "--mount-proc", "--uts", "--ipc"]


def booted(folder: Path, bank: Path, *options: str) -> dict[str, list[str]]:
    """Boot, and return what the probe saw; skips where no such system can be had."""
    if os.geteuid() != 0 or not SYSTEMD.exists():
        pytest.skip("booting a systemd of one's own needs root and Debian's systemd: `make system-packages`")
    shutil.copy(bank, folder / "tiny.bank")
    shutil.copy(HERE / "probe.sh", folder)
    fingertip = {"device": {"serial_number": "1"}, "bank": "/var/lib/shearloop/banks/tiny.bank"}
    config = {
        "publish": "ipc:///run/shearloop/publish",
        "commands": "tcp://127.0.0.1:*",
        "fingertips": {"right": fingertip},
    }
    (folder / "shearloop.yaml").write_text(yaml.safe_dump(config))
    paths = [sys.base_prefix, sysconfig.get_path("purelib"), str(HERE.parents[2])]
    # A boot that hangs is ended with all its processes; if it hung before the probe ran, nothing is seen below.
    with (folder / "unshare.log").open("w") as refused, contextlib.suppress(subprocess.TimeoutExpired):
        subprocess.run(
            [*NAMESPACES, "/bin/sh", str(HERE / "under_systemd.sh"), str(folder), *paths, *options],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=refused,
            timeout=90,
            check=False,
        )
    if not (folder / "seen").exists():
        said = [log.read_text() for log in (folder / "unshare.log", folder / "boot.log") if log.exists()]
        why = "".join(said).strip().splitlines()[-1:]
        pytest.skip(f"this kernel or container boots no systemd of ours: {' '.join(why)}")
    seen: dict[str, list[str]] = {}
    for line in (folder / "seen").read_text().splitlines():
        what, colon, value = line.partition(": ")
        if colon:
            seen.setdefault(what, []).append(value)
    assert "end" in seen, seen
    return seen


@pytest.mark.long
def test_the_service_starts_and_restarts_after_kill_and_hang_but_not_after_a_mistake(tmp_path, tiny_bank):
    seen = booted(tmp_path, tiny_bank)
    assert seen["started"] == ["0"], "READY=1 came, and ZeroMQ could make its threads and sockets"
    assert seen["alive"] == ["6 tasks are alive"]
    assert (seen["user"], seen["capabilities"]) == (["shearloop"], ["0" * 16])
    assert seen["stop socket"] == ["1"]
    assert seen["policy"] == ["SCHED_OTHER"]
    assert (seen["killed"], seen["hung"]) == (["1"], ["2"])
    assert seen["again"] == ["6 tasks are alive"] * 2
    assert seen["stopped"] == ["success 0"]
    assert seen["mistake"] == ["status 2, 0 restarts"]


@pytest.mark.long
def test_the_service_starts_with_the_real_time_options(tmp_path, tiny_bank):
    (tmp_path / "start_only").touch()
    seen = booted(tmp_path, tiny_bank, "--real-time")
    assert (seen["started"], seen["alive"]) == (["0"], ["6 tasks are alive"])
    assert seen["policy"] == ["SCHED_FIFO"]
    assert seen["stopped"] == ["success 0"]
