"""One reader of a node: its position, its interval, what it lost; copy, check, update, wait.

The arithmetic is docs/node.md, "Reading": a position is the number of the next write to
read; generations are 62 bits wide and never wrap (at a million samples a second: 146,000 years).
"""

from collections.abc import Callable, Iterator
from time import monotonic
from typing import TYPE_CHECKING, Any, Generic, NamedTuple, TypeVar, cast

from .broker import members
from .broker.layout import FLAG_LATCHED, GENERATION, MOVED, UNADVERTISED, W_FLOOR, W_G, W_LAPSED, W_PRIORITY
from .broker.slots import Sample as Slot
from .broker.slots import damaged, decoded, read
from .clock import hrt_absolute_time
from .errors import ClosedError, DecodeError, NoDataError
from .waiting import wait_for_one

if TYPE_CHECKING:
    from .broker.node import Node
    from .exported import Exported
    from .messages import Message, MessageType

M = TypeVar("M", bound="Message")
DEATH_CHECK = 0.5  # seconds between two looks whether the publishers of a node live
STARTS = ("latest", "new", "oldest")


class SampleInfo(NamedTuple):
    """What the bus knows of a sample beside the message.

    Times are microseconds of this host's clock; `published_us` is 0 while a remote clock's offset is
    unknown. `generation` and `sequence` count from 1, `sequence` at the publisher's host.
    """

    generation: int
    published_us: int
    received_us: int
    origin: str
    sequence: int
    latched: bool


class Sample(NamedTuple, Generic[M]):
    """A message with its info."""

    message: M
    info: SampleInfo


class _Closed:
    """Stands in for the words of a closed subscription: any access tells."""

    def __init__(self, text: str) -> None:
        self._text = text

    def __getitem__(self, index: int) -> int:
        raise ClosedError(self._text)


class Subscription(Generic[M]):
    """A reader of one topic instance. Made by `Broker.subscribe`; lives until closed."""

    __slots__ = (
        "_closed", "_closed_by", "_decode", "_exported", "_interval", "_last", "_lost", "_mapping", "_node",
        "_position", "_quiet", "_since", "_words", "queue_size",
    )  # fmt: skip

    def __init__(
        self, node: "Node", start: str, interval: float, on_close: Callable[["Subscription[Any]"], None]
    ) -> None:
        self._node = node
        self._decode: Callable[[Any, int], M] = node.type.decode
        self._interval = 0.0
        self._last = 0.0
        self._lost = 0
        self._closed = False
        self._closed_by = on_close
        self._exported: Exported | None = None
        self.queue_size = 0
        self._words: memoryview[int] = node.mapping.words
        self._follow()
        self._since = hrt_absolute_time() if start == "new" else 0  # until when latched samples are no update
        self._begin(start)
        self._interval = _seconds(interval)
        members.enlist(node, self)

    def _begin(self, start: str) -> None:
        word = self._words[W_G]
        generation, floor = word & GENERATION, self._words[W_FLOOR]
        if start == "new" or word & UNADVERTISED:
            self._position = generation
        else:
            back = 1 if start == "latest" else self._mapping.queue_length
            # Nothing from before a mirror's demand lapsed is an update: newer samples are missing behind it.
            self._position = max(generation - back, floor, self._words[W_LAPSED])
        self._quiet = self._position

    # -- state -------------------------------------------------------------------------------------

    @property
    def topic(self) -> str:
        """The topic's name."""
        return self._node.label.topic

    @property
    def closed(self) -> bool:
        """Whether it was closed, with its broker, or belongs to the parent of a fork."""
        return self._closed

    @property
    def instance(self) -> int:
        """The instance, 0..9."""
        return self._node.label.instance

    @property
    def type(self) -> "MessageType":
        """The message type in use on the node."""
        return self._node.type

    @property
    def queue_length(self) -> int:
        """How many samples readers of this node can still get one by one."""
        self._current()
        return self._mapping.queue_length

    @property
    def priority(self) -> int:
        """The publisher's priority, 1..255; 75 for a node never advertised."""
        self._current()
        return self._words[W_PRIORITY]

    @property
    def generation(self) -> int:
        """This subscription's position: the number of the next write it will read."""
        self._words[W_G]
        return self._position

    @property
    def lost(self) -> int:
        """Samples overwritten before this subscription read them; counted by the copy that passes over."""
        return self._lost

    @property
    def advertised(self) -> bool:
        """Whether a live publisher advertises the node."""
        word = self._current()
        return not word & UNADVERTISED and (self._node.publishing > 0 or self._published())

    @property
    def pending(self) -> int:
        """Unread samples that can still be read one by one."""
        word = self._current()
        if word & UNADVERTISED:
            return 0
        return min(word - max(self._position, self._words[W_FLOOR]), self._mapping.queue_length)

    @property
    def interval(self) -> float:
        """The least time between two updates, seconds; 0: none."""
        self._words[W_G]
        return self._interval

    @interval.setter
    def interval(self, seconds: float) -> None:
        self._words[W_G]
        self._interval = _seconds(seconds)
        self._quiet = -1
        members.enlist(self._node, self)
        self._node.poke_own()
        if self._exported is not None:
            self._exported.settle()

    @property
    def interval_us(self) -> int:
        """The interval in microseconds."""
        return round(self._interval * 1e6)

    # -- reading -----------------------------------------------------------------------------------

    def check(self) -> bool:
        """Tell whether an unread sample is there and the interval has passed. Changes nothing."""
        word = self._words[W_G]
        if word == self._quiet:
            return False
        return self._look(word)

    def _look(self, word: int) -> bool:
        """Answer `check` for a G that is not the one last answered no."""
        if word >> 62:
            word = self._current()
            if word & UNADVERTISED:
                self._quiet = word
                return False
        if word <= self._position or word <= self._words[W_FLOOR]:
            self._quiet = word
            return False
        if self._since and not self._pass_latched(word):
            return False
        if self._interval and monotonic() - self._last < self._interval:
            return False
        node = self._node
        return node.publishing > 0 or monotonic() - node.checked < DEATH_CHECK or self._published()

    def _pass_latched(self, word: int) -> bool:
        """Step over latched samples that were published before this subscription; True if another is unread.

        For `start="new"` they can be copied, but are no update.
        """
        for number in range(max(self._position, self._words[W_FLOOR], word - self._mapping.queue_length), word):
            slot = read(self._mapping, number)
            if slot is None or not slot.flags & FLAG_LATCHED or slot.published_us > self._since:
                self._since = 0  # the flow has begun: what is latched comes first and alone
                return True
            self._position = number + 1
        self._quiet = word
        return False

    def copy(self) -> M:
        """Return the newest sample, or the next unread one of a queue.

        Raises:
            NoDataError: nothing was published in this advertisement, or nobody advertises.
            ClosedError: the subscription is closed.
            DecodeError: the sample's bytes were damaged, by whatever writes to foreign memory; it counts as lost.
        """
        node = self._node
        while True:
            number = self._choose()
            generation, message = node.cache
            if generation != number + 1:
                message = cast("Message | None", decoded(self._mapping, number, self._decode))
                if message is None:
                    self._failed(number)
                    continue
                node.cache = (number + 1, message)
            if number == self._position and not self._interval and self._exported is None:
                self._position = self._quiet = number + 1  # `_advance` in the commonest case, without the call
                self._last = monotonic()
            else:
                self._advance(number)
            return cast(M, message)

    def copy_with_info(self) -> Sample[M]:
        """Return what `copy` does, with its `SampleInfo`; raises as `copy`."""
        while True:
            number = self._choose()
            slot = read(self._mapping, number)
            if slot is not None:
                self._advance(number)
                return Sample(self._decode(slot.payload, 0), self._info(slot))
            self._failed(number)

    def _failed(self, number: int) -> None:
        """Choose again after a write that was overtaken while it was read; pass over one whose bytes are damaged."""
        if damaged(self._mapping, number):
            unread = number >= self._position
            self._advance(number)
            if unread:
                self._count_lost(number + 1, 1)
            raise DecodeError(f"{self._node.name}: sample {number + 1} is damaged in the bus's memory")

    def update(self) -> M | None:
        """Return `copy()` if `check()`, else None."""
        if not self.check():
            return None
        try:
            return self.copy()
        except NoDataError:
            return None  # unadvertised between the two

    def _choose(self) -> int:
        """Return the number of the write to deliver."""
        words = self._words
        word = words[W_G]
        if word >> 62:
            word = self._current()
            if word & UNADVERTISED:
                raise NoDataError(f"{self._node.name} is not advertised")
            words = self._words
        floor = words[W_FLOOR]
        if word <= floor:
            raise NoDataError(f"nothing was published on {self._node.name}")
        node = self._node
        if not node.publishing and monotonic() - node.checked >= DEATH_CHECK and not self._published():
            raise NoDataError(f"the publisher of {self._node.name} is gone")
        length = self._mapping.queue_length
        if length == 1 or self._position >= word or self._interval:
            return word - 1
        return max(self._position, word - length, floor)

    def _advance(self, number: int) -> None:
        """Move behind a delivered write, counting what it passed over."""
        now = monotonic()
        passed = number - self._position
        if passed >= 0:
            self._position = self._quiet = number + 1
            if passed and not self._interval:
                self._count_lost(number, passed)
        interval = self._interval
        self._last = min(max(self._last + interval, now - interval), now) if interval else now
        if self._exported is not None:
            self._exported.settle()

    def _count_lost(self, number: int, passed: int) -> None:
        passed = min(passed, number - self._words[W_FLOOR])  # an earlier advertisement's are not lost
        self._lost += passed
        self._node.count_lost(passed)

    def _info(self, slot: Slot) -> SampleInfo:
        origin = self._mapping.origin(slot.origin) or self._node.directory.host
        latched = bool(slot.flags & FLAG_LATCHED)
        return SampleInfo(slot.number, slot.published_us, slot.received_us, origin, slot.sequence, latched)

    def stat(self) -> int:
        """Return when the node was last written, microseconds of this host's clock; 0 for never."""
        while True:
            word = self._current() & GENERATION
            if not word:
                return 0
            slot = read(self._mapping, word - 1)
            if slot is not None:
                return slot.received_us
            if damaged(self._mapping, word - 1):
                return 0

    # -- waiting -----------------------------------------------------------------------------------

    def wait(self, timeout: float | None = None) -> bool:
        """Block until `check()` is true, at most `timeout` seconds (None: without limit)."""
        return self.check() or wait_for_one(self, timeout)

    def rest(self) -> float:
        """Return the seconds until the interval has passed; 0 if it has, or there is none."""
        return max(self._last + self._interval - monotonic(), 0.0) if self._interval else 0.0

    def due_in(self) -> float | None:
        """Return the seconds until a sample held back by the interval is due; None if none is held."""
        if not self._interval:
            return None
        word = self._words[W_G]
        if word >> 62 or word <= max(self._position, self._words[W_FLOOR]):
            return None
        return self.rest()

    def __iter__(self) -> Iterator[M]:
        while True:
            self.wait()
            message = self.update()
            if message is not None:
                yield message

    def fileno(self) -> int:
        """Return a descriptor that is readable while an update is pending, for select, selectors, asyncio.

        It may be readable once too often, so `update` after it, and up to 1 s late after a publisher
        was killed in the act. It belongs to the subscription and is closed with it.
        """
        self._words[W_G]
        if self._exported is None:
            from .exported import Exported

            self._exported = Exported(self)
        return self._exported.end.fd

    async def next(self, timeout: float | None = None) -> M | None:
        """Return the next unread sample, waiting for it in the running event loop; None on timeout."""
        from .awaiting import next_message

        return await next_message(self, timeout)

    def __aiter__(self) -> "Subscription[M]":
        return self

    async def __anext__(self) -> M:
        message = await self.next()
        assert message is not None  # it has no timeout
        return message

    # -- the node ----------------------------------------------------------------------------------

    def _current(self) -> int:
        """Return G, after following a node that was moved."""
        while (word := self._words[W_G]) & MOVED:
            self._node.recover()
            self._follow()  # the node may have moved before it knew this subscription
        return word

    def _follow(self) -> None:
        """Pick up the node's present buffer, unless closed meanwhile."""
        if self._closed:
            return
        self._mapping = self._node.mapping
        self._words = self._mapping.words
        if self.closed:  # by another thread, just now
            self.spend()

    def _published(self) -> bool:
        """Tell whether a publisher lives; asked of the kernel at most twice a second."""
        node = self._node
        now = monotonic()
        if now - node.checked < DEATH_CHECK:
            return True
        node.checked = now
        if members.advertised(node.directory, self._mapping):
            return True
        node.checked = 0.0
        return not members.bury(node.directory, node)

    # -- closing -----------------------------------------------------------------------------------

    def close(self) -> None:
        """Unsubscribe; waits on this subscription end with ClosedError. A second call does nothing."""
        if self._closed:
            return
        self.spend()
        if self._exported is not None:
            self._exported.close()
        self._node.poke_own()  # before the sleepers' entries go
        members.unsubscribe(self._node, self)
        self._closed_by(self)

    def spend(self) -> None:
        """Make every later call raise ClosedError."""
        self._closed = True
        self._words = cast("memoryview[int]", _Closed(f"subscription to {self._node.name} is closed"))
        self._quiet = -1

    def __enter__(self) -> "Subscription[M]":
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()

    def __repr__(self) -> str:
        return f"<Subscription {self._node.name}>"


def _seconds(interval: float) -> float:
    if not interval >= 0.0:
        raise ValueError(f"interval = {interval!r}: seconds, 0 or more")
    return float(interval)
