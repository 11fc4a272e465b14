"""Whether who ended this task is still to be obeyed."""

import asyncio


def is_cancelled() -> bool:
    """Return whether the current task was told to end.

    Where something in it fails in the same moment Python's task groups tell of the failure alone (3.13 no longer does):
    who goes on then is told to end by nobody any more. Before 3.13 a group whose own body was over when a task of it
    failed leaves the same mark: in what is supervised the body lasts as long as the tasks, as that of `UrRobot` does.
    """
    task = asyncio.current_task()
    return task is not None and task.cancelling() > 0
