"""Waiting for a subscription in an asyncio event loop: its descriptor, watched while somebody waits."""

import asyncio
import os
from typing import TYPE_CHECKING, TypeVar

from .broker.descriptors import more_descriptors

if TYPE_CHECKING:
    from .exported import Exported
    from .messages import Message
    from .subscription import Subscription

M = TypeVar("M", bound="Message")


async def next_message(subscription: "Subscription[M]", timeout: float | None) -> M | None:
    """Return the next unread sample; None when `timeout` seconds passed first. Cancelling loses nothing."""
    message = subscription.update()
    if message is not None:
        await asyncio.sleep(0)  # a flood must not keep the loop from its other tasks
        return message
    loop = asyncio.get_running_loop()
    deadline = None if timeout is None else loop.time() + timeout
    while True:
        left = None if deadline is None else deadline - loop.time()
        if left is not None and left <= 0:
            return None
        subscription.fileno()
        assert subscription._exported is not None
        await _readable(loop, subscription._exported, left)
        message = subscription.update()
        if message is not None:
            return message


async def _readable(loop: asyncio.AbstractEventLoop, exported: "Exported", seconds: float | None) -> None:
    """Wait until a descriptor is readable or closed, or time is up."""
    woken = loop.create_future()

    def wake() -> None:
        if not woken.done():
            woken.set_result(None)

    # A copy: a loop has one reader per descriptor, and must not be left with one that was closed.
    if exported.closed:
        return
    fd = more_descriptors(lambda: os.dup(exported.end.fd))
    loop.add_reader(fd, wake)
    waiter = (loop, wake)
    exported.waiting.add(waiter)
    try:
        if not exported.closed:  # by another thread, before it knew of this waiter
            await asyncio.wait([woken], timeout=seconds)
    finally:
        exported.waiting.discard(waiter)
        loop.remove_reader(fd)
        os.close(fd)
