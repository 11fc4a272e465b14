"""Keeps the process's memory out of swap, so that no cycle of the loop waits for the disk."""

import ctypes
import os
import resource

from shearloop.daemon.errors import UserError

_MCL_CURRENT, _MCL_FUTURE = 1, 2


def lock_memory() -> None:
    """Lock all memory that the process has and will have; raises UserError where its limit would not allow it."""
    limit, _ = resource.getrlimit(resource.RLIMIT_MEMLOCK)
    if limit != resource.RLIM_INFINITY and os.geteuid() != 0:
        # Locked now, the process would be refused memory later, in the middle of its work.
        raise UserError(
            f"`lock_memory: true` needs an unlimited RLIMIT_MEMLOCK, and it is {limit / 1024:.0f} kB: run "
            "`sudo shearloop install --real-time`, or take `lock_memory` out of the configuration"
        )
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.mlockall(_MCL_CURRENT | _MCL_FUTURE) != 0:
        raise UserError(
            f"`lock_memory: true` was refused by the system ({os.strerror(ctypes.get_errno())}); "
            "take it out of the configuration"
        )
