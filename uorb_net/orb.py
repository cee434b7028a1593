"""The functions of the uORB guide, by their own names, on a process-wide default broker.

They keep uORB's units (milliseconds for intervals and timeouts, microseconds for time) and raise where
C returns -1; the exception's `errno` is uORB's. Handles are opaque.
"""

from threading import Lock
from time import sleep
from typing import Any

import msgspec

from .broker import Broker
from .broker.broker import ORB_QUEUE_LENGTH_MAX, Priority
from .errors import ClosedError, TopicMismatchError, UorbError
from .messages import Message
from .publication import Publication
from .subscription import Subscription
from .waiting import poll

__all__ = [
    "ORB_ID",
    "ORB_PRIO_DEFAULT",
    "ORB_PRIO_HIGH",
    "ORB_PRIO_LOW",
    "ORB_PRIO_MAX",
    "ORB_PRIO_MIN",
    "ORB_PRIO_VERY_HIGH",
    "ORB_PRIO_VERY_LOW",
    "ORB_QUEUE_LENGTH_MAX",
    "POLLIN",
    "default_broker",
    "orb_advertise",
    "orb_advertise_multi",
    "orb_advertise_multi_queue",
    "orb_advertise_queue",
    "orb_check",
    "orb_copy",
    "orb_exists",
    "orb_get_interval",
    "orb_group_count",
    "orb_priority",
    "orb_publish",
    "orb_publish_auto",
    "orb_set_interval",
    "orb_stat",
    "orb_subscribe",
    "orb_subscribe_multi",
    "orb_unadvertise",
    "orb_unsubscribe",
    "px4_poll",
    "px4_pollfd",
    "set_default_broker",
]

ORB_PRIO_MIN = int(Priority.MIN)
ORB_PRIO_VERY_LOW = int(Priority.VERY_LOW)
ORB_PRIO_LOW = int(Priority.LOW)
ORB_PRIO_DEFAULT = int(Priority.DEFAULT)
ORB_PRIO_HIGH = int(Priority.HIGH)
ORB_PRIO_VERY_HIGH = int(Priority.VERY_HIGH)
ORB_PRIO_MAX = int(Priority.MAX)
POLLIN = 1

_lock = Lock()
_broker: Broker | None = None


class OrbMetadata(msgspec.Struct, frozen=True):
    """What `ORB_ID` gives: a topic."""

    topic: str


def default_broker() -> Broker:
    """Return the process-wide broker, made when first asked for, and again after it was closed."""
    global _broker  # noqa: PLW0603 - the guide's functions have no object to hang it on
    with _lock:
        if _broker is None or _broker.closed:
            _broker = Broker()
        return _broker


def set_default_broker(broker: Broker) -> None:
    """Make the functions of this module work on `broker` from now on."""
    global _broker  # noqa: PLW0603
    with _lock:
        _broker = broker


def ORB_ID(name: str) -> OrbMetadata:  # noqa: N802 - uORB's name
    """Return the topic of that name; UnknownTopicError (ENOENT) if there is none."""
    default_broker().resolve(name)
    return OrbMetadata(name)


# -- publishing -----------------------------------------------------------------------------------


def orb_advertise(meta: OrbMetadata, data: Message | None) -> Publication[Any]:
    """Advertise instance 0 and publish `data` unless it is None.

    Raises:
        TopicMismatchError: `data` is of another type (EINVAL).
    """
    return default_broker().advertise(meta, data)


def orb_advertise_queue(meta: OrbMetadata, data: Message | None, queue_size: int) -> Publication[Any]:
    """Advertise instance 0 with a queue of `queue_size` samples, 1..255."""
    return default_broker().advertise(meta, data, queue_length=queue_size)


def orb_advertise_multi(meta: OrbMetadata, data: Message | None, priority: int = ORB_PRIO_DEFAULT) -> Publication[Any]:
    """Advertise the lowest free instance, told by the handle's `instance`; InstanceError (EIO) if none is."""
    return default_broker().advertise_multi(meta, data, priority=priority)


def orb_advertise_multi_queue(
    meta: OrbMetadata, data: Message | None, priority: int, queue_size: int
) -> Publication[Any]:
    """Advertise the lowest free instance with a queue."""
    return default_broker().advertise_multi(meta, data, priority=priority, queue_length=queue_size)


def orb_publish(meta: OrbMetadata, handle: Publication[Any], data: Message) -> None:
    """Publish; EINVAL for another topic's `meta` or type, EBADF after orb_unadvertise."""
    _same_topic(meta, handle)
    handle.publish(data)


def orb_publish_auto(
    meta: OrbMetadata, handle: Publication[Any] | None, data: Message, priority: int = ORB_PRIO_DEFAULT
) -> Publication[Any]:
    """Publish, advertising an instance of one's own first where `handle` is None; return the handle."""
    if handle is None:
        return orb_advertise_multi(meta, data, priority)
    orb_publish(meta, handle, data)
    return handle


def orb_unadvertise(handle: Publication[Any]) -> None:
    """Stop publishing; a second call does nothing."""
    handle.unadvertise()


# -- subscribing ----------------------------------------------------------------------------------


def orb_subscribe(meta: OrbMetadata) -> Subscription[Any]:
    """Subscribe to instance 0: later publications are updates, earlier data an unconditional copy gets."""
    return default_broker().subscribe(meta, start="new")


def orb_subscribe_multi(meta: OrbMetadata, instance: int) -> Subscription[Any]:
    """Subscribe to an instance; InstanceError (EIO) if it is out of range."""
    return default_broker().subscribe(meta, instance, start="new")


def orb_unsubscribe(handle: Subscription[Any]) -> None:
    """Unsubscribe; a second call raises ClosedError (EBADF)."""
    if handle.closed:
        raise ClosedError(f"{handle!r} is unsubscribed already")
    handle.close()


def orb_copy(meta: OrbMetadata, handle: Subscription[Any]) -> Any:
    """Return the message.

    Raises:
        NoDataError: nothing was published, or nobody advertises (EIO).
        TopicMismatchError: `meta` is not the handle's topic; nothing is consumed (EINVAL).
        ClosedError: unsubscribed (EBADF).
    """
    _same_topic(meta, handle)
    return handle.copy()


def orb_check(handle: Subscription[Any]) -> bool:
    """Tell whether there is an update; stays true until a copy."""
    return handle.check()


def orb_stat(handle: Subscription[Any]) -> int:
    """Return the microseconds of the last publication; 0 for never."""
    return handle.stat()


def orb_priority(handle: Subscription[Any]) -> int:
    """Return the priority of the node's publisher, 1..255."""
    return handle.priority


def orb_set_interval(handle: Subscription[Any], milliseconds: int) -> None:
    """Set the least time between two updates; 0: none."""
    handle.interval = milliseconds / 1000


def orb_get_interval(handle: Subscription[Any]) -> int:
    """Return the interval in milliseconds."""
    return round(handle.interval * 1000)


def orb_exists(meta: OrbMetadata, instance: int) -> bool:
    """Tell whether the instance is advertised; False for an impossible one."""
    return default_broker().exists(meta, instance)


def orb_group_count(meta: OrbMetadata) -> int:
    """Return how many instances are advertised."""
    return default_broker().group_count(meta)


def _same_topic(meta: OrbMetadata, handle: Publication[Any] | Subscription[Any]) -> None:
    if meta.topic != handle.topic:
        raise TopicMismatchError(f"ORB_ID({meta.topic}) is not the handle's topic, {handle.topic}")


# -- polling --------------------------------------------------------------------------------------


class px4_pollfd:  # noqa: N801 - uORB's name
    """One entry of `px4_poll`: a handle, what to wait for, what was found."""

    __slots__ = ("events", "fd", "revents")

    def __init__(self, fd: Any, events: int = POLLIN) -> None:
        self.fd = fd
        self.events = events
        self.revents = 0

    def __repr__(self) -> str:
        return f"px4_pollfd(fd={self.fd!r}, events={self.events}, revents={self.revents})"


def px4_poll(fds: list[px4_pollfd], timeout_ms: int) -> int:
    """Wait for updates; set each entry's `revents`, return how many have one, 0 on timeout.

    Args:
        fds: the entries; those with `events` 0 never report, closed handles are passed over.
        timeout_ms: 0 does not wait, below 0 waits without limit.

    Raises:
        UorbError: no entry has a valid handle (EINVAL).
    """
    for entry in fds:
        entry.revents = 0
    valid = [entry for entry in fds if isinstance(entry.fd, Subscription) and not entry.fd.closed]
    if not valid:
        raise UorbError("px4_poll: no entry has a valid handle")
    timeout = None if timeout_ms < 0 else timeout_ms / 1000
    waiting = [entry for entry in valid if entry.events & POLLIN]
    ready = set(poll([entry.fd for entry in waiting], timeout)) if waiting else _sleep(timeout)
    for entry in waiting:
        entry.revents = POLLIN if entry.fd in ready else 0
    return sum(entry.revents != 0 for entry in fds)


def _sleep(timeout: float | None) -> set[Any]:
    """Wait as poll(2) does with nothing to wait for."""
    while timeout is None:
        sleep(3600.0)
    sleep(timeout)
    return set()
