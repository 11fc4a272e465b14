"""How long a rig's devices may be silent or late: a real rig's deadlines, or an emulated one's, which are longer."""

from shearloop.daemon.config import DaemonConfig

# An emulated rig cannot hurt: its deadlines are longer by this factor, so that it survives a busy computer.
EMULATED_PATIENCE = 10.0
# A torque of an emulated sensor, and a state of an emulated robot, is fresh for this long.
EMULATED_STALE_S = 5.0


def patience_of(config: DaemonConfig) -> float:
    """Return the factor on the deadlines of a rig's devices: above 1 for an emulated rig alone."""
    return EMULATED_PATIENCE if is_patient(config) else 1.0


def is_patient(config: DaemonConfig) -> bool:
    """Return whether deadlines fit a busy computer: nothing that is emulated can hurt."""
    return config.emulated and config.emulated_deadlines == "patient"
