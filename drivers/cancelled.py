"""Whether who ended this task is still to be obeyed."""

import asyncio


def is_cancelled() -> bool:
    """Return whether the current task was told to end.

    Where something in it fails in the same moment Python's task groups tell of the failure alone (3.13 no longer does):
    who goes on then is told to end by nobody any more.
    """
    task = asyncio.current_task()
    return task is not None and task.cancelling() > 0
