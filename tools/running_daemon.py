"""The daemon that runs at an address, and its owner."""

from collections.abc import Mapping
from typing import Any

from shearloop.daemon.running_rig import EMULATED


def whose_daemon(reply: Mapping[str, Any]) -> str:
    """Return whose daemon gave this reply to `status`: EMULATED, process, name of the rig, and folder."""
    daemon = reply.get("daemon", {})
    label = f"{EMULATED}, " if daemon.get("emulated") else ""
    return f"{label}process {daemon.get('process')} ({daemon.get('rig')}) in {daemon.get('folder')}"
