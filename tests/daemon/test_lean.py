"""What keeps the daemon small and quick to start."""

import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from shearloop.daemon.control.loop_runner import along_tool

# Each costs tens of megabytes and tenths of a second, and none is needed to run.
HEAVY = ("scipy.stats", "scipy.optimize", "scipy.spatial", "scipy.interpolate", "skfem", "numba", "matplotlib")


def test_the_daemon_imports_no_heavy_modules():
    says = f"import sys, shearloop.daemon.app; print([name for name in {HEAVY} if name in sys.modules])"
    found = subprocess.run([sys.executable, "-c", says], capture_output=True, text=True, check=True)
    assert found.stdout.strip() == "[]"


def test_a_stop_imports_little():
    """On a busy computer, imports are most of the time that `shearloop command stop` takes."""
    says = """if True:
        import os, socket, sys, threading
        import msgpack
        from shearloop.daemon.cli import main
        from shearloop.daemon.messaging.stop_client import stop_name

        address = f"ipc:///lean-{os.getpid()}"
        daemon = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        daemon.bind(stop_name(address))

        def reply():
            request, client = daemon.recvfrom(1024)
            assert msgpack.unpackb(request) == {"command": "stop"}
            daemon.sendto(msgpack.packb({"ok": True, "stopped": "one"}), client)

        threading.Thread(target=reply, daemon=True).start()
        main(["command", "stop", "--connect", address])
        print([name for name in ("numpy", "zmq", "asyncio", "structlog", "tqdm") if name in sys.modules])
    """
    found = subprocess.run([sys.executable, "-c", says], capture_output=True, text=True, check=True)
    assert found.stdout == "stop: stopped one\n[]\n"


@given(st.lists(st.floats(-7, 7), min_size=3, max_size=3), st.floats(-1, 1))
def test_along_tool_moves_along_the_third_axis(turned, distance_m):
    found = along_tool((0.1, -0.2, 0.3, *turned), distance_m)
    axis = Rotation.from_rotvec(turned).as_matrix()[:, 2]
    assert found[:3] == pytest.approx(np.array([0.1, -0.2, 0.3]) + distance_m * axis, abs=1e-12)
    assert found[3:] == tuple(turned)
