"""Deadlines in coroutines, with the one of this Python and with ours for earlier ones."""

import asyncio

import pytest

from shearloop.timeouts import Deadline, timeout

pytestmark = pytest.mark.parametrize("deadline", [timeout, Deadline])


async def test_a_block_in_time_ends_as_without_a_deadline(deadline):
    async with deadline(60.0):
        await asyncio.sleep(0)
    with pytest.raises(ValueError, match="its own"):
        async with deadline(60.0):
            raise ValueError("its own")


@pytest.mark.parametrize("delay_s", [0.0, -1.0, 0.001])
async def test_a_block_that_takes_longer_ends(deadline, delay_s):
    with pytest.raises(TimeoutError):
        async with deadline(delay_s):
            await asyncio.Event().wait()
    assert asyncio.current_task().cancelling() == 0


async def test_a_task_that_is_cancelled_within_the_deadline_is_cancelled(deadline):
    async def waits() -> None:
        async with deadline(60.0):
            await asyncio.Event().wait()

    task = asyncio.create_task(waits())
    await asyncio.sleep(0)
    task.cancel()
    with pytest.raises(asyncio.CancelledError):
        await task


async def test_what_a_cancelled_task_still_does_has_a_deadline(deadline):
    """As a device that is put into a safe state: what follows the deadline is done, and then the task ends."""
    done = []

    async def leaves_a_device_safe() -> None:
        try:
            await asyncio.Event().wait()
        finally:
            try:
                async with deadline(0.001):
                    await asyncio.Event().wait()
            except TimeoutError:
                done.append("told")

    task = asyncio.create_task(leaves_a_device_safe())
    await asyncio.sleep(0)
    task.cancel()
    with pytest.raises(asyncio.CancelledError):
        await task
    assert done == ["told"]


async def test_of_two_deadlines_the_earlier_one_ends_its_block_alone(deadline):
    async with deadline(60.0):
        with pytest.raises(TimeoutError):
            async with deadline(0.001):
                await asyncio.Event().wait()
        await asyncio.sleep(0)
    with pytest.raises(TimeoutError):
        async with deadline(0.001), deadline(60.0):
            await asyncio.Event().wait()
