"""What a client adds to a request: the daemon that it is meant for, when it was asked for, and when it is too late.

It imports little, so that `shearloop command stop` is quick on a busy computer.
"""

from collections.abc import Mapping
from typing import Any, Final

from shearloop.errors import UserError

# The page's clicks, and commands that are typed, whose program takes a while to begin on a busy computer.
CLICK_WITHIN_S: Final = 2.0
TYPED_WITHIN_S: Final = 5.0


class LateRequestError(UserError):
    """The operator asked for it too long ago: it was not sent."""


def meant_for(status: Mapping[str, Any], age_s: float, within_s: float) -> dict[str, str | int]:
    """Return what binds a request to the daemon that gave this reply to `status`, and to the operator's act.

    The act was at most `age_s` ago when the reply came. A daemon that begins later refuses the request. This one
    refuses it later than `within_s` after the act, or after a `stop` or `pause` since then. Raises LateRequestError if
    no time is left. Nothing binds it to a daemon that does not say which one it is, or what its clock shows.
    """
    if age_s > within_s:
        raise LateRequestError(
            f"it may have been asked for {age_s:.1f} s ago, and nothing begins later than {within_s:g} s after that; "
            "look at the rig, and send it again"
        )
    daemon = status.get("daemon", {})
    bound: dict[str, str | int] = {}
    if isinstance(instance := daemon.get("instance"), str):
        bound["instance"] = instance
    if isinstance(now_ns := daemon.get("now_ns"), int):
        asked_ns = now_ns - round(age_s * 1e9)
        bound |= {"asked_ns": asked_ns, "until_ns": asked_ns + round(within_s * 1e9)}
    return bound
