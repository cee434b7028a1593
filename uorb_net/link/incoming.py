"""What other hosts offer, mirrored on this bus: one mirror per remote topic instance.

Bytes are checked for length and header and written as they came, below the publish layer, so nothing
received is ever sent on. Numbers that are missing and were not withheld are asked for once where the
topic has a queue, and count as lost if the sender's ring has them no more.
"""

from collections.abc import Callable
from threading import Lock
from time import monotonic

from communicator import Advert, Peer, SampleHeader

from ..broker.layout import FLAG_LATCHED
from ..broker.node import Node
from ..clock import hrt_absolute_time
from ..errors import BusyError, ClosedError
from .peers import PeerState
from .status import TopicLinkStats

GAP_WAIT = 0.5  # seconds a queued topic waits for what it asked for; well below the lease
HEAD_GRACE = 0.15  # seconds a sample may come after the head that tells of it
WAITING = 256  # samples of one stream kept while a gap is asked for
STUCK_PAUSE = 1.0  # seconds a node is left alone after a process stopped inside it

AskGap = Callable[["Mirror", int, int], None]


class Mirror:
    """One remote topic instance. Written by its stream's receiving thread, steered by the link's."""

    def __init__(self, state: PeerState, advert: Advert) -> None:
        self.state = state
        self.peer: Peer = state.peer
        self.advert = advert
        self.node: Node | None = None
        self.origin = 0  # index of the host in the node's origin table
        self.demand_us: int | None = None  # the interval asked for; None: nobody here subscribes
        self.base = True  # the next sample or head sets the base: nothing before it is loss
        self._resumed = False  # the base is where a cut ended the former mirror
        self._assumed = 0  # the base as a first sample set it, until a head has told
        self.newest = 0  # highest sequence written
        self.waiting: dict[int, tuple[SampleHeader, bytes]] = {}
        self._asked = 0.0  # when the present gap was asked for; 0: none
        self._asked_last = 0  # the last number asked for
        self._owed = 0  # the newest number that a head told of, if it was news
        self._owed_since = 0.0
        self._lock = Lock()  # a stream's samples and its heads come in different threads
        self.stuck_until = 0.0
        self.refused = ""  # why it has no node, as last told
        self.received = 0
        self.lost = 0
        self.retransmitted = 0
        self.thinned = 0

    @property
    def name(self) -> str:
        """The topic as its own host numbers it."""
        return f"{self.advert.topic}.{self.advert.instance}" if self.advert.instance else self.advert.topic

    @property
    def instance(self) -> int | None:
        """The number on this host; None while it has none."""
        return None if self.node is None else self.node.label.instance

    def receive(self, header: SampleHeader, payload: bytes, ask: AskGap) -> bool:
        """Take a sample; False if its bytes cannot be the topic's."""
        if len(payload) != self.advert.payload_length or payload[:2] != b"\x00\x01":
            return False
        with self._lock:
            if self.base:
                self._begin_at(header.sequence)
            if header.sequence <= self.newest:
                return True  # a second copy, or the latched sample that is here already
            missing = header.sequence - self.newest - 1 - header.withheld
            if missing <= 0 or not self._hold(header, payload, ask):
                self._take(header, payload)
                self._release()
        return True

    def _begin_at(self, sequence: int) -> None:
        """Take a first sample for the first there was; a head may correct that."""
        self.base = False
        self._assumed = sequence - 1
        if sequence != self.newest:  # else it is here already, from before the demand lapsed
            self.newest = sequence - 1

    def _hold(self, header: SampleHeader, payload: bytes, ask: AskGap) -> bool:
        """Keep a sample while what is missing before it is asked for; False if it is not worth waiting."""
        if self.advert.queue_length == 1 or len(self.waiting) >= WAITING:
            return False
        self.waiting[header.sequence] = (header, payload)
        self._ask(header.sequence - 1, ask)
        return True

    def _ask(self, last: int, ask: AskGap) -> None:
        if not self._asked:
            self._asked = monotonic()
            self._asked_last = last
            ask(self, self.newest + 1, last)

    def _release(self) -> None:
        """Write waiting samples that are in order now."""
        while self.waiting:
            first = min(self.waiting)
            header, payload = self.waiting[first]
            if first - self.newest - 1 > header.withheld:
                return
            del self.waiting[first]
            if first > self.newest:
                self._take(header, payload)
        if self.newest >= self._asked_last:
            self._asked = 0.0

    def look_after(self, now: float, ask: AskGap) -> None:
        """Give up what did not come, ask for what a head has shown to be missing; called a few times a second."""
        with self._lock:
            if self._asked and now - self._asked >= GAP_WAIT:
                self._give_up()
            if self._owed > self.newest and not self._asked and now - self._owed_since >= HEAD_GRACE:
                if self.advert.queue_length == 1:  # only the newest is worth asking for
                    self._count_lost(self._owed - 1 - self.newest)
                    self.newest = self._owed - 1
                self._ask(self._owed, ask)

    def _give_up(self) -> None:
        """Count as lost what was asked for and did not come, and go on with what waits."""
        while self.waiting:
            first = min(self.waiting)
            header, payload = self.waiting.pop(first)
            if first > self.newest:
                self._take(header, payload)
        if self.newest < self._asked_last:
            self._count_lost(self._asked_last - self.newest)
            self.newest = self._asked_last
        self._asked = 0.0

    def head(self, base: int, sequence: int) -> None:
        """Learn what the sender owes: a lost first or last sample shows here.

        A head may overtake the samples it tells of, which travel in another class; so it is acted upon later.
        """
        with self._lock:
            if self.base:
                self.base = False
                self.newest = max(self.newest, base)  # not twice what is here from before the demand lapsed
            elif base < self._assumed:
                self._count_lost(self._assumed - base)
            self._assumed = 0
            if sequence > self.newest and self._owed <= self.newest:
                self._owed = sequence
                self._owed_since = monotonic()

    def begin(self) -> None:
        """Somebody here subscribes (again): the next sample sets the base, unless the peer was only cut off."""
        with self._lock:
            self.base = not self._resumed
            self._resumed = False

    def resume(self, newest: int) -> None:
        """Go on counting where a cut ended the former mirror of this very stream."""
        self.newest = newest
        self._resumed = True

    def end(self) -> None:
        """Nobody here subscribes any more."""
        with self._lock:
            self._resumed = False
            self.demand_us = None
            self.waiting.clear()
            self._asked = 0.0
            self._owed = 0

    def _take(self, header: SampleHeader, payload: bytes) -> None:
        missing = header.sequence - self.newest - 1
        withheld = min(header.withheld, missing)
        self.thinned += withheld
        self._count_lost(missing - withheld)
        self.newest = header.sequence
        if self._asked and header.sequence <= self._asked_last:
            self.retransmitted += 1
        self._write(header, payload)

    def _write(self, header: SampleHeader, payload: bytes) -> None:
        node = self.node
        now = hrt_absolute_time()
        if node is None or monotonic() < self.stuck_until:
            self._count_lost(1)
            return
        published = min(self.state.local_us(header.published_us), now)
        flags = FLAG_LATCHED if header.latched else 0
        try:
            node.write(payload, published, now, header.sequence, self.origin, flags)
        except BusyError:
            self.stuck_until = monotonic() + STUCK_PAUSE
            self._count_lost(1)
        except ClosedError:
            self._count_lost(1)  # withdrawn at this moment; the link's thread finds out by itself
        else:
            self.received += 1
            self.state.received += 1

    def _count_lost(self, count: int) -> None:
        if not count:
            return
        self.lost += count
        self.state.lost += count
        node = self.node
        if node is not None:
            node.count_network_lost(count)

    def stats(self) -> TopicLinkStats:
        """Return the totals."""
        return TopicLinkStats(
            topic=self.advert.topic,
            instance=self.advert.instance,
            origin=self.peer.host,
            received=self.received,
            lost=self.lost,
            retransmitted=self.retransmitted,
            thinned=self.thinned,
        )
