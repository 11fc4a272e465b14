"""Which daemon this is, and which rig it drives, as it says in `health` and in its reply to `status`."""

import secrets
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final, Self

if TYPE_CHECKING:
    # `shearloop command stop` imports little.
    from shearloop.daemon.config import DaemonConfig

EMULATED: Final = "EMULATED"
EMULATED_HEADING: Final = f"{EMULATED}: every device of this rig is emulated."


@dataclass(frozen=True, slots=True)
class RunningRig:
    """A daemon's rig: its name, whether it is emulated, its address of messages, its devices; and the daemon itself."""

    rig: str = ""
    emulated: bool = False
    publish: str = ""
    # The address of each device, by its key in the configuration.
    devices: Mapping[str, str] = field(default_factory=dict)
    # Random for each daemon: in a container, each process has the same number.
    instance: str = field(default_factory=lambda: secrets.token_hex(8))

    @classmethod
    def of(cls, config: "DaemonConfig", robot_host: str | None) -> Self:
        """Return the rig of a configuration, whose robot has this address."""
        robot = {"robot": robot_host} if robot_host is not None else {}
        return cls(config.name, config.emulated, config.publish, {**config.device_addresses, **robot})
