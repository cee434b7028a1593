"""Waiting for subscriptions: level triggered, without a thread that polls.

Check, arm in each node's table, check again, sleep on one descriptor; look again after 2, 16 and
128 ms and then every second, so that a wake-up lost to a killed publisher delays and never hangs.
"""

from collections.abc import Sequence
from time import monotonic, sleep
from typing import TYPE_CHECKING, Any

from .broker.waking import LOOKS, Sleeper, give_back, take
from .errors import ClosedError

if TYPE_CHECKING:
    from .subscription import Subscription

CROWDED = 0.005  # seconds between looks where a node's sleeper table is full


def poll(subscriptions: "Sequence[Subscription[Any]]", timeout: float | None = None) -> "list[Subscription[Any]]":
    """Return those of `subscriptions` that have an update, in their order; wait for the first.

    Args:
        subscriptions: any number, also of several brokers. Level triggered: one that is not copied
            is returned again by the next call.
        timeout: seconds; None waits without limit, 0 or less does not wait.

    Returns:
        The ready ones; empty on timeout.

    Raises:
        ValueError: no subscription and no timeout, which would wait for ever.
        ClosedError: one of them is closed, or is being closed meanwhile.
    """
    if not subscriptions:
        if timeout is None:
            raise ValueError("poll([]) without a timeout would wait for ever")
        sleep(max(timeout, 0.0))
        return []
    return ready(subscriptions) or wait_for(subscriptions, timeout)


def ready(subscriptions: "Sequence[Subscription[Any]]") -> "list[Subscription[Any]]":
    """Return those that have an update now, each once."""
    found = [subscription for subscription in subscriptions if subscription.check()]
    return found if len(found) < 2 else list(dict.fromkeys(found))


def wait_for(subscriptions: "Sequence[Subscription[Any]]", timeout: float | None) -> "list[Subscription[Any]]":
    """Sleep until one is ready; the caller has looked already and found none."""
    if timeout is not None and timeout <= 0:
        return []
    deadline = None if timeout is None else monotonic() + timeout
    sleeper = take()
    try:
        return _sleep(subscriptions, sleeper, deadline)
    except ClosedError:
        sleeper.leave_closed()
        raise
    finally:
        give_back(sleeper)


def wait_for_one(subscription: "Subscription[Any]", timeout: float | None) -> bool:
    """Do what `wait_for` does for the commonest case, without lists: a round trip is made of this."""
    if timeout is not None and timeout <= 0:
        return False
    deadline = 0.0 if timeout is None else monotonic() + timeout
    left = timeout
    sleeper = take()
    look = 0
    try:
        directory = subscription._node.directory
        number = sleeper.end(directory).number
        while True:
            armed = directory.arm(subscription._node.mapping.words, number)
            if subscription.check():
                return True
            seconds = LOOKS[look] if armed else CROWDED
            if subscription._interval:
                due = subscription.due_in()
                seconds = seconds if due is None else min(seconds, due)
            if left is not None and left < seconds:
                seconds = left
            if sleeper.sleep(seconds):
                look = 0
            elif look < len(LOOKS) - 1:
                look += 1
            if subscription.check():
                return True
            if deadline:
                left = deadline - monotonic()
                if left <= 0:
                    return False
    except ClosedError:
        sleeper.leave_closed()
        raise
    finally:
        give_back(sleeper)


def _sleep(
    subscriptions: "Sequence[Subscription[Any]]", sleeper: Sleeper, deadline: float | None
) -> "list[Subscription[Any]]":
    look = 0
    while True:
        full = False
        for subscription in subscriptions:
            node = subscription._node
            full |= not node.directory.arm(node.mapping.words, sleeper.end(node.directory).number)
        found = ready(subscriptions)
        if found:
            return found
        seconds = CROWDED if full else LOOKS[look]
        for subscription in subscriptions:
            due = subscription.due_in()
            if due is not None and due < seconds:
                seconds = due
        if deadline is not None:
            left = deadline - monotonic()
            if left <= 0:
                return []
            seconds = min(seconds, left)
        woken = sleeper.sleep(seconds)
        look = 0 if woken else min(look + 1, len(LOOKS) - 1)
        found = ready(subscriptions)
        if found:
            return found
