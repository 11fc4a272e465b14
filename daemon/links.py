"""What the log says when a device comes or goes."""

import structlog

from shearloop.drivers.connection import LinkEvent


def log_link(device: str, event: LinkEvent) -> None:
    """Log that a serial or network device came or went."""
    log_event(device, event.up, event.sentence, repeated=event.repeated)


def log_event(device: str, up: bool, sentence: str, *, repeated: bool) -> None:
    """Log a change of a link: coming is news, going a warning, and going again a detail."""
    log = structlog.get_logger().bind(device=device)
    (log.info if up else log.debug if repeated else log.warning)(sentence)
