"""Waiting for a subscription in an asyncio event loop: its descriptor, watched while somebody waits."""

import asyncio
from typing import TYPE_CHECKING, TypeVar

if TYPE_CHECKING:
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
        await _readable(loop, subscription.fileno(), left)
        message = subscription.update()
        if message is not None:
            return message


async def _readable(loop: asyncio.AbstractEventLoop, fd: int, seconds: float | None) -> None:
    """Wait until a descriptor is readable, or time is up."""
    woken = loop.create_future()

    def wake() -> None:
        if not woken.done():
            woken.set_result(None)

    loop.add_reader(fd, wake)
    try:
        await asyncio.wait([woken], timeout=seconds)
    finally:
        loop.remove_reader(fd)
