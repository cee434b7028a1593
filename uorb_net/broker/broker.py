"""The host's bus as a program sees it: opens publications and subscriptions, tells what there is."""

import atexit
import os
from contextlib import suppress
from enum import IntEnum
from typing import TYPE_CHECKING, Any, TypeVar, overload

from ..errors import BusError, ClosedError, InstanceError, QueueLengthError, UnknownTopicError
from . import members
from .directory import Directory, PrivateDirectory
from .layout import is_topic
from .shared import opening, process_directory
from .survey import Survey, TopicStatus, survey

if TYPE_CHECKING:
    from ..link import Link
    from ..messages import Message, MessageType
    from ..publication import Publication
    from ..subscription import Subscription

M = TypeVar("M", bound="Message")
ORB_QUEUE_LENGTH_MAX = 255


class Priority(IntEnum):
    """Priorities of publishers, as uORB has them."""

    MIN = 1
    VERY_LOW = 25
    LOW = 50
    DEFAULT = 75
    HIGH = 100
    VERY_HIGH = 125
    MAX = 255


class Broker:
    """The bus of one vehicle on this host, shared by every process of this user; needs no daemon."""

    def __init__(self, vehicle: str | None = None) -> None:
        """Open the bus, made where it is not there.

        Args:
            vehicle: its name, `$UORB_VEHICLE` or "default" if not given. Letters, digits, `_ . -`.

        Raises:
            BusError: the runtime directory (`$UORB_RUNTIME_DIR`) is unusable.
        """
        name = vehicle or os.environ.get("UORB_VEHICLE") or "default"
        if name.startswith(".") or not all(c.isalnum() or c in "_-." for c in name) or len(name) > 64:
            raise ValueError(f"vehicle = {name!r}: letters, digits, _ . - only, at most 64, not starting with a dot")
        self.vehicle = name
        with opening:  # or the last other broker of the folder closes it before this one counts
            self._open(process_directory(name))

    def _open(self, directory: Directory) -> None:
        self._directory = directory
        self._users: set[Publication[Any] | Subscription[Any] | Link] = set()
        self._closed = False
        _brokers.add(self)

    @classmethod
    def private(cls, vehicle: str = "default") -> "Broker":
        """Return a bus of this process alone, in its own memory: for tests and simulations."""
        broker = cls.__new__(cls)
        broker.vehicle = vehicle
        broker._open(PrivateDirectory())
        return broker

    @property
    def closed(self) -> bool:
        """Whether it was closed, or belongs to the parent of a fork."""
        return self._closed

    @property
    def path(self) -> str:
        """The folder of the bus; "(private)" for one in memory."""
        return self._directory.path

    @property
    def host(self) -> str:
        """This host's name: its link's, else `$UORB_HOST`, else the system's."""
        return self._directory.host

    # -- publishing --------------------------------------------------------------------------------

    @overload
    def advertise(
        self, topic: type[M], data: M | None = None, *, queue_length: int | None = None
    ) -> "Publication[M]": ...
    @overload
    def advertise(
        self, topic: Any, data: "Message | None" = None, *, queue_length: int | None = None
    ) -> "Publication[Any]": ...
    def advertise(
        self, topic: Any, data: "Message | None" = None, *, queue_length: int | None = None
    ) -> "Publication[Any]":
        """Become a publisher of instance 0, which any number of publishers may share.

        Args:
            topic: a topic name, a message type (its first topic), or `ORB_ID(name)`.
            data: a first message to publish.
            queue_length: 1..255; else the definition's, else 1. The first publisher's choice holds
                while the node has data.

        Raises:
            UnknownTopicError, TopicMismatchError, QueueLengthError, EncodeError: the call is wrong.
            BusError: no room on the RAM file system, or too many publishing processes.
        """
        return self._advertise(topic, 0, data, Priority.DEFAULT, queue_length)

    @overload
    def advertise_multi(
        self, topic: type[M], data: M | None = None, *, priority: int = 75, queue_length: int | None = None
    ) -> "Publication[M]": ...
    @overload
    def advertise_multi(
        self,
        topic: Any,
        data: "Message | None" = None,
        *,
        priority: int = 75,
        queue_length: int | None = None,
    ) -> "Publication[Any]": ...
    def advertise_multi(
        self,
        topic: Any,
        data: "Message | None" = None,
        *,
        priority: int = Priority.DEFAULT,
        queue_length: int | None = None,
    ) -> "Publication[Any]":
        """Become the publisher of the lowest free instance; arguments and errors as `advertise`.

        Raises:
            InstanceError: all 10 instances are advertised.
        """
        if not 1 <= priority <= 255:
            raise ValueError(f"priority = {priority}: 1..255")
        return self._advertise(topic, None, data, priority, queue_length)

    def advertise_instance(
        self,
        type: "type[Message]",
        topic: str,
        instance: int,
        *,
        priority: int = Priority.DEFAULT,
        queue_length: int | None = None,
    ) -> "Publication[Any]":
        """Become a publisher of a given instance, also where lower ones are missing: for replayed logs.

        Args:
            type: the message type; `topic` need not be one of its own.
            topic: the topic's name.
            instance: 0..9; others may share it.
            priority, queue_length: as for `advertise`.

        Instance 0 is shared, as `advertise` has it; the others are own, as `advertise_multi` has them.
        """
        self._alive()
        if not 0 <= instance < members.INSTANCES:
            raise InstanceError(f"instance = {instance}: 0..{members.INSTANCES - 1}")
        return self._join(type.__uorb__, topic, instance, int(priority), queue_length, own=instance > 0)

    def _advertise(
        self, topic: Any, instance: int | None, data: Any, priority: int, queue_length: int | None
    ) -> "Publication[Any]":
        self._alive()
        name, type_ = self.resolve(topic, instance or 0)
        publication = self._join(type_.__uorb__, name, instance, int(priority), queue_length, own=instance is None)
        if data is not None:
            try:
                publication.publish(data)
            except BaseException:
                publication.unadvertise()
                raise
        return publication

    def _join(
        self,
        type_: "MessageType",
        name: str,
        instance: int | None,
        priority: int,
        queue_length: int | None,
        *,
        own: bool,
    ) -> "Publication[Any]":
        from ..publication import Publication

        if queue_length is not None and not 1 <= queue_length <= ORB_QUEUE_LENGTH_MAX:
            raise QueueLengthError(f"queue_length = {queue_length}: 1..{ORB_QUEUE_LENGTH_MAX}")
        node = members.advertise(
            self._directory,
            type_,
            name,
            instance,
            priority=priority,
            queue_length=queue_length,
            own=own,
        )
        publication: Publication[Any] = Publication(node, priority, self._users.discard)
        self._users.add(publication)
        return publication

    # -- subscribing -------------------------------------------------------------------------------

    @overload
    def subscribe(
        self,
        topic: type[M],
        instance: int = 0,
        *,
        interval: float = 0.0,
        start: str = "latest",
        definition: str = "own",
    ) -> "Subscription[M]": ...
    @overload
    def subscribe(
        self,
        topic: Any,
        instance: int = 0,
        *,
        interval: float = 0.0,
        start: str = "latest",
        definition: str = "own",
    ) -> "Subscription[Any]": ...
    def subscribe(
        self,
        topic: Any,
        instance: int = 0,
        *,
        interval: float = 0.0,
        start: str = "latest",
        definition: str = "own",
    ) -> "Subscription[Any]":
        """Become a reader; works before anyone advertises.

        Args:
            topic: a topic name, a message type, or `ORB_ID(name)`. A name that only the bus knows,
                because another process or host brought its definition, works too.
            instance: 0..9.
            interval: the least seconds between two updates; 0: every sample.
            start: what counts as an update at first: "latest" the newest sample there is, "new" only
                later ones, "oldest" all that the queue retains.
            definition: "own" reads with the definition installed here; "publisher" with the one the
                topic's publisher brought, whatever is installed: for tools that read any topic.

        Raises:
            UnknownTopicError, TopicMismatchError, InstanceError: the call is wrong.
            BusError: no room on the RAM file system, or too many subscribing processes.
        """
        from ..subscription import STARTS, Subscription

        self._alive()
        if start not in STARTS:
            raise ValueError(f"start = {start!r}: one of {', '.join(STARTS)}")
        if not 0 <= instance < members.INSTANCES:
            raise InstanceError(f"instance = {instance}: 0..{members.INSTANCES - 1}")
        if definition not in ("own", "publisher"):
            raise ValueError(f"definition = {definition!r}: own or publisher")
        name, type_ = self._choose(topic, instance) if definition == "publisher" else self.resolve(topic, instance)
        node = members.subscribe(self._directory, type_.__uorb__, name, instance)
        try:
            subscription: Subscription[Any] = Subscription(node, start, interval, self._users.discard)
        except BaseException:
            members.give_up(node)
            raise
        self._users.add(subscription)
        return subscription

    # -- looking -----------------------------------------------------------------------------------

    def exists(self, topic: Any, instance: int = 0) -> bool:
        """Tell whether someone, here or on another host, advertises the instance."""
        self._alive()
        name, _ = self.resolve(topic)
        return 0 <= instance < members.INSTANCES and self._advertised(name, instance)

    def group_count(self, topic: Any) -> int:
        """Return how many instances of a topic are advertised."""
        return sum(self.exists(topic, instance) for instance in range(members.INSTANCES))

    def topics(self) -> list[TopicStatus]:
        """Return the status of every node, sorted by topic and instance."""
        return [node.status for node in self.survey()]

    def survey(self) -> list[Survey]:
        """Return every node's status with what only tools ask: size, last write, definition."""
        self._alive()
        return survey(self._directory)

    def resolve(self, topic: Any, instance: int = 0) -> tuple[str, "type[Message]"]:
        """Return a topic argument's name and type; the bus is asked where no definition is installed.

        Raises:
            UnknownTopicError: neither a definition installed here nor a node of that name.
        """
        from .. import messages

        if isinstance(topic, type) and issubclass(topic, messages.Message):
            return topic.__uorb__.topics[0], topic
        name = topic if isinstance(topic, str) else getattr(topic, "topic", None)
        if not isinstance(name, str):
            raise TypeError(f"topic = {topic!r}: a topic name, a message type, or ORB_ID(name)")
        try:
            return name, messages.type_for_topic(name)
        except UnknownTopicError:
            found = self.type_on_bus(name, instance)
            if found is None:
                raise
            return name, found

    def _choose(self, topic: Any, instance: int) -> tuple[str, "type[Message]"]:
        """Return a topic's name and its publisher's type, the installed one where nobody publishes."""
        if not isinstance(topic, str) or not self.advertised(topic):
            return self.resolve(topic, instance)
        found = self.type_on_bus(topic, instance)
        return (topic, found) if found is not None else self.resolve(topic, instance)

    def advertised(self, topic: str, instance: int | None = None) -> bool:
        """Tell whether somebody alive advertises a topic's instance, or any; False for an unknown name."""
        if not is_topic(topic):
            return False
        return any(self._advertised(topic, n) for n in range(members.INSTANCES) if instance in (None, n))

    def _advertised(self, topic: str, instance: int) -> bool:
        mapping = self._directory.find(topic, instance, populate=False)
        return mapping is not None and members.advertised(self._directory, mapping)

    def type_on_bus(self, topic: str, instance: int = 0) -> "type[Message] | None":
        """Return the type a topic has on the bus, whatever is installed here; None if nobody brought one.

        A node that somebody alive advertises counts first, the instance asked for before the others.
        """
        from .. import messages

        if not is_topic(topic):
            return None
        found = [self._directory.find(topic, n, populate=False) for n in (instance, *range(members.INSTANCES))]
        mappings = [mapping for mapping in found if mapping is not None]
        mappings.sort(key=lambda mapping: not members.advertised(self._directory, mapping))
        if not mappings:
            return None
        label = mappings[0].label()
        return messages.from_text(label.type_name, label.definition)

    # -- closing -----------------------------------------------------------------------------------

    def close(self) -> None:
        """Close everything opened through this broker; a second call does nothing."""
        if self._closed:
            return
        for user in list(self._users):
            with suppress(BusError):  # the folder was removed: nothing left to leave
                user.close()
        self._closed = True
        with opening:
            _brokers.discard(self)
            if not any(broker._directory is self._directory for broker in _brokers):
                self._directory.close()

    def spend(self) -> None:
        """Make every later call on this broker and what it opened raise ClosedError."""
        self._closed = True
        for user in self._users:
            user.spend()

    def _alive(self) -> None:
        if self._closed:
            raise ClosedError("broker is closed, or belongs to the parent of this forked process: make a new Broker")

    def __enter__(self) -> "Broker":
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()

    def __repr__(self) -> str:
        return f"<Broker {self.vehicle} {self.path}>"


_brokers: set[Broker] = set()  # dropping the last reference closes nothing


def _close_all() -> None:
    for broker in list(_brokers):
        broker.close()


def _forget_all() -> None:
    """In a forked child: nothing of the parent's survives."""
    for broker in _brokers:
        broker.spend()
        broker._directory.abandon()
    _brokers.clear()


atexit.register(_close_all)
os.register_at_fork(after_in_child=_forget_all)
