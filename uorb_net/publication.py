"""One publisher of a node."""

from collections.abc import Callable
from time import monotonic_ns
from typing import TYPE_CHECKING, Any, Generic, NoReturn, TypeVar, cast

from .broker import members
from .broker.layout import MOVED, W_G
from .errors import BusError, ClosedError, TopicMismatchError

if TYPE_CHECKING:
    from .broker.node import Node
    from .messages import Message, MessageType

M = TypeVar("M", bound="Message")


class Publication(Generic[M]):
    """A publisher of one topic instance. Made by `Broker.advertise`; lives until unadvertised."""

    __slots__ = ("_class", "_closed_by", "_encode", "_left", "_node", "_priority", "_write")

    def __init__(self, node: "Node", priority: int, on_close: Callable[["Publication[Any]"], None]) -> None:
        self._node = node
        self._priority = priority
        self._class = node.type.cls
        self._encode = node.type.encode
        self._write: Callable[[bytes, int, int], None] = node.write
        self._closed_by = on_close
        self._left = False

    @property
    def topic(self) -> str:
        """The topic's name."""
        return self._node.label.topic

    @property
    def instance(self) -> int:
        """The instance, 0..9."""
        return self._node.label.instance

    @property
    def type(self) -> "MessageType":
        """The message type of the node."""
        return self._node.type

    @property
    def priority(self) -> int:
        """The priority given when advertising, 1..255."""
        return self._priority

    @property
    def queue_length(self) -> int:
        """The queue length in force, which the node's first publisher chose."""
        node = self._node
        if node.mapping.words[W_G] & MOVED:
            node.recover()
        return node.mapping.queue_length

    def publish(self, message: M) -> None:
        """Write a message to the bus; never blocks on a subscriber or on the network.

        A `timestamp` of 0 is stamped with `hrt_absolute_time()`.

        Raises:
            TopicMismatchError: the message is not of the topic's type.
            EncodeError: a value does not fit its field; nothing is published.
            ClosedError: unadvertised, or used in a forked child.
            BusyError: a co-publisher of the instance is stopped in the middle of a publication.
        """
        if type(message) is not self._class:
            message = self._converted(message)
        now = monotonic_ns() // 1000
        self._write(self._encode(message, now), now, now)

    def publish_encoded(self, payload: bytes) -> None:
        """Write a message that is encoded already: `type.payload_length` bytes, header included.

        Raises:
            ValueError: the length is not the type's.
        """
        if len(payload) != self._node.mapping.length:
            raise ValueError(f"{self.topic}: {len(payload)} bytes, {self._node.mapping.length} expected")
        now = monotonic_ns() // 1000
        self._write(payload, now, now)

    def _converted(self, message: object) -> M:
        """Accept the same type loaded another way (from a peer's text), refuse all others."""
        kind: MessageType | None = getattr(type(message), "__uorb__", None)
        if kind is None or kind.type_hash != self._node.type.type_hash:
            raise TopicMismatchError(f"{self.topic} takes {self._class.__name__}, not {type(message).__name__}")
        return cast(M, message)

    def unadvertise(self) -> None:
        """Stop publishing; the topic stays advertised while any publisher of it remains.

        Raises:
            BusError: the bus cannot be told now; this publishes no more, a second call tries again.
        """
        if self._left:
            return
        self.spend()
        try:
            members.unadvertise(self._node)
        except BusError:
            self._left = False
            raise
        self._closed_by(self)

    close = unadvertise

    def spend(self) -> None:
        """Make every later publish raise ClosedError."""
        self._left = True
        self._encode = _spent
        self._write = _spent

    def __enter__(self) -> "Publication[M]":
        return self

    def __exit__(self, *exc: object) -> None:
        self.unadvertise()

    def __repr__(self) -> str:
        return f"<Publication {self._node.name}>"


def _spent(*_: Any) -> NoReturn:
    raise ClosedError("publication was unadvertised, its broker closed, or this is a forked child")
