"""The configuration of a rehearsal, which remembers the real devices."""

from collections.abc import Mapping
from typing import Any

from pydantic import PrivateAttr

from shearloop.daemon.config import DaemonConfig


class RehearsedConfig(DaemonConfig):
    """A configuration in which all devices of a real configuration are replaced by emulated ones."""

    _real: DaemonConfig = PrivateAttr()

    def __init__(self, real: DaemonConfig, content: Mapping[str, Any]) -> None:
        """`real` has the real devices; `content` is the configuration of the emulated ones."""
        super().__init__(**content)
        self._real = real

    @property
    def real(self) -> DaemonConfig:
        """The configuration of the real devices."""
        return self._real
