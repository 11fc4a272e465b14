"""The library that drives the robot, ur-rtde: whether the right version is installed and can be loaded."""

import platform
import shlex
import sys
from importlib import import_module
from importlib.metadata import PackageNotFoundError, version
from importlib.util import find_spec
from typing import Final

# The script on the robot uses the protocol of this version only.
CLIENT_VERSION: Final = "1.6.5"


def missing_library() -> str:
    """Return why the robot cannot be driven with this Python, or an empty string."""
    pip = f"{shlex.quote(sys.executable)} -m pip install"
    if find_spec("rtde_control") is None:
        return (
            f"the robot needs the package ur-rtde, which is not installed for Python {platform.python_version()} on "
            f"{platform.machine()}: use Python 3.11 or 3.12 on x86-64, or build it with "
            f"`{pip} ur-rtde=={CLIENT_VERSION}`, which needs cmake, g++, git and Boost's headers"
        )
    try:
        import_module("rtde_control")
    except ImportError as error:
        again = f"`{pip} --force-reinstall --no-deps ur-rtde=={CLIENT_VERSION}`"
        return f"the package ur-rtde, which drives the robot, cannot be loaded: install it again with {again} ({error})"
    return why_other_client()


def why_other_client() -> str:
    """Return why the installed ur-rtde cannot drive our script, or an empty string."""
    try:
        found = version("ur-rtde")
    except PackageNotFoundError:
        found = "unknown"
    if found == CLIENT_VERSION:
        return ""
    return (
        f"the installed ur-rtde is of version {found}, and the script for the robot speaks only the protocol of "
        f"{CLIENT_VERSION}: install it with `{shlex.quote(sys.executable)} -m pip install ur-rtde=={CLIENT_VERSION}`"
    )
