"""A network in this process, with scripted delay, loss, duplication, reordering and cuts.

Tokens behave as Zenoh's do: reliable, in order per direction, taken away when a cut outlasts the
lease, brought up to date when it heals. Frames carry one record each and suffer what the link is set
to. All of it is decided by the seed, direction by direction.
"""

import heapq
import logging
from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import count
from random import Random
from threading import Condition, Thread, current_thread
from time import monotonic

from communicator.channel import ChannelHandler, Peer
from communicator.counters import Counters
from communicator.node import Node, NodeChannel, Slot
from communicator.outbox import Lane
from communicator.tokens import HostToken, SubscriptionToken, Token

log = logging.getLogger(__name__)
_REORDER_HOLD = 0.01  # seconds a record is held back so that later ones overtake it
_STOP_TIMEOUT = 1.9


@dataclass(frozen=True, slots=True)
class LinkQuality:
    """What happens to a record on its way: seconds, and probabilities from 0 to 1."""

    delay: float = 0.0
    jitter: float = 0.0
    loss: float = 0.0
    duplicate: float = 0.0
    reorder: float = 0.0

    def __post_init__(self) -> None:
        for name in ("loss", "duplicate", "reorder"):
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise ValueError(f"{name} is a probability: 0 to 1")
        if self.delay < 0.0 or self.jitter < 0.0:
            raise ValueError("delay and jitter are seconds: not negative")


@dataclass(slots=True, eq=False)
class _Path:
    """One direction between two nodes. Everything in flight carries the epoch it was sent in."""

    source: "MemoryNode"
    target: "MemoryNode"
    random: Random
    sent: dict[Token, None] = field(default_factory=dict)  # what the target will have seen
    applied: dict[Token, None] = field(default_factory=dict)  # what it has seen
    epoch: int = 0
    tokens_due: float = 0.0
    frames_due: float = 0.0

    def wanted(self) -> list[Token]:
        """Return the source's tokens that concern the target."""
        return [t for t in self.source.tokens.values() if self.concerns(t)]

    def concerns(self, token: Token) -> bool:
        """Tell whether the target looks at this token."""
        return not isinstance(token, SubscriptionToken) or token.publisher_id == self.target.own.instance_id


class MemoryNetwork:
    """Joins MemoryChannels of this process.

    With `manual` nothing moves until `advance`, which delivers in the caller's thread; `now` is then
    virtual and starts at 0. Otherwise one thread delivers in real time, while any channel is started.
    """

    def __init__(self, *, seed: int = 0, manual: bool = False, lease: float = 2.0) -> None:
        self._seed = seed
        self._manual = manual
        self._lease = lease
        self._random = Random(seed)
        self._changed = Condition()
        self._now = 0.0
        self._order = count()
        self._events: list[tuple[float, int, MemoryNode, Callable[[], None]]] = []
        self._nodes: list[MemoryNode] = []
        self._paths: dict[tuple[MemoryNode, MemoryNode], _Path] = {}
        self._quality: dict[tuple[str, str], LinkQuality] = {}
        self._cuts: dict[frozenset[str], int] = {}
        self._thread: Thread | None = None
        self._busy: MemoryNode | None = None
        self._lost = 0

    @property
    def manual(self) -> bool:
        """Whether time is virtual."""
        return self._manual

    @property
    def now(self) -> float:
        """Seconds: virtual, or those of `time.monotonic`."""
        return self._now if self._manual else monotonic()

    @property
    def lost(self) -> int:
        """Records that loss and cuts have taken so far."""
        with self._changed:
            return self._lost

    def channel(self) -> "MemoryChannel":
        """Return a new channel on this network."""
        return MemoryChannel(self)

    # -- the script

    def set_link(
        self,
        a: str,
        b: str,
        *,
        delay: float = 0.0,
        jitter: float = 0.0,
        loss: float = 0.0,
        duplicate: float = 0.0,
        reorder: float = 0.0,
    ) -> None:
        """Set how records fare from host `a` to host `b`; the other direction keeps its own.

        Delay and jitter hold for tokens too. A reordered record is held back for 10 ms more.
        """
        with self._changed:
            self._quality[a, b] = LinkQuality(delay, jitter, loss, duplicate, reorder)

    def cut(self, a: str, b: str) -> None:
        """Let nothing pass between two hosts, what is under way included; after the lease they part."""
        with self._changed:
            pair = frozenset((a, b))
            if pair in self._cuts:
                return
            self._cuts[pair] = number = next(self._order)
            for path in self._between(pair):
                path.epoch += 1
                path.sent = dict(path.applied)
                self._schedule(self.now + self._lease, path.target, self._expiry(path, pair, number))

    def heal(self, a: str, b: str) -> None:
        """Let everything pass again; tokens are brought up to date, lost records are not."""
        with self._changed:
            pair = frozenset((a, b))
            if self._cuts.pop(pair, None) is not None:
                for path in self._between(pair):
                    self._synchronise(path)
                self._drop_dead_paths()

    def advance(self, seconds: float) -> None:
        """Let virtual time pass and deliver all that falls due, in the caller's thread.

        Raises:
            RuntimeError: the network runs in real time.
        """
        if not self._manual:
            raise RuntimeError("advance() is for MemoryNetwork(manual=True)")
        target = self._now + seconds
        while (event := self._due(target)) is not None:
            self._run(*event)
        with self._changed:
            self._now = max(self._now, target)

    # -- what channels and their nodes call

    def draw_id(self) -> str:
        """Return an instance id, the seed's next."""
        with self._changed:
            return f"{self._random.getrandbits(64):016x}"

    def join(self, node: "MemoryNode") -> None:
        """Connect a node with all others of its vehicle."""
        with self._changed:
            for other in self._nodes:
                if other.vehicle == node.vehicle:
                    for source, target in ((node, other), (other, node)):
                        path = _Path(source, target, Random(f"{self._seed}/{source.own}/{target.own}"))
                        self._paths[source, target] = path
                        self._synchronise(path)
            self._nodes.append(node)
            if not self._manual and self._thread is None:
                self._thread = Thread(target=self._deliver, name="uorb-memory", daemon=True)
                self._thread.start()

    def leave(self, node: "MemoryNode") -> None:
        """Disconnect a node, and wait until no call to its handler is under way."""
        with self._changed:
            if node not in self._nodes:
                return
            self._nodes.remove(node)
            node.tokens.clear()
            for (source, target), path in list(self._paths.items()):
                if target is node:
                    path.epoch += 1
                    del self._paths[source, target]
                elif source is node:
                    self._synchronise(path)
            self._drop_dead_paths()
            self._await_quiet(node)

    def show(self, node: "MemoryNode", slot: Slot, token: Token | None) -> None:
        """Replace the token of a node's slot, the new one first."""
        with self._changed:
            old = node.tokens.pop(slot, None)
            if token is not None:
                node.tokens[slot] = token
            if old == token:
                return
            for path in [p for p in self._paths.values() if p.source is node]:
                if token is not None:
                    self._send_token(path, token, True)
                if old is not None:
                    self._send_token(path, old, False)

    def transmit(self, node: "MemoryNode", peer: Peer, frame: bytes) -> None:
        """Send one frame, as the link between the two hosts is set."""
        with self._changed:
            path = next((p for p in self._paths.values() if p.source is node and p.target.own == peer), None)
            if path is None:
                return
            quality = self._quality_of(path)
            if self._is_cut(path) or path.random.random() < quality.loss:
                self._lost += 1
                return
            for _ in range(2 if path.random.random() < quality.duplicate else 1):
                self._send_frame(path, quality, frame)

    # -- inside, with the lock held

    def _await_quiet(self, node: "MemoryNode") -> None:
        self._changed.notify_all()
        if current_thread() is self._thread:
            return
        self._changed.wait_for(lambda: self._busy is not node, _STOP_TIMEOUT)
        self._changed.wait_for(lambda: self._thread is None or bool(self._nodes), _STOP_TIMEOUT)

    def _drop_dead_paths(self) -> None:
        # A path of a node that left stays while it is cut: its target has yet to hear of that.
        for (source, target), path in list(self._paths.items()):
            if source not in self._nodes and not self._is_cut(path):
                del self._paths[source, target]

    def _between(self, pair: frozenset[str]) -> list[_Path]:
        return [p for p in self._paths.values() if frozenset((p.source.own.host, p.target.own.host)) == pair]

    def _quality_of(self, path: _Path) -> LinkQuality:
        return self._quality.get((path.source.own.host, path.target.own.host), LinkQuality())

    def _is_cut(self, path: _Path) -> bool:
        return frozenset((path.source.own.host, path.target.own.host)) in self._cuts

    def _schedule(self, due: float, node: "MemoryNode", action: Callable[[], None]) -> None:
        heapq.heappush(self._events, (due, next(self._order), node, action))
        self._changed.notify_all()

    def _synchronise(self, path: _Path) -> None:
        wanted = path.wanted()
        for token in wanted:
            self._send_token(path, token, True)
        for token in [t for t in path.sent if t not in dict.fromkeys(wanted)]:
            self._send_token(path, token, False)

    def _send_token(self, path: _Path, token: Token, present: bool) -> None:
        if self._is_cut(path) or present == (token in path.sent) or not path.concerns(token):
            return
        if present:
            path.sent[token] = None
        else:
            del path.sent[token]
        quality = self._quality_of(path)
        due = self.now + quality.delay + quality.jitter * path.random.random()
        path.tokens_due = max(path.tokens_due, due)
        epoch = path.epoch
        self._schedule(path.tokens_due, path.target, lambda: self._apply_token(path, epoch, token, present))

    def _send_frame(self, path: _Path, quality: LinkQuality, frame: bytes) -> None:
        due = self.now + quality.delay + quality.jitter * path.random.random()
        if path.random.random() < quality.reorder:
            due += _REORDER_HOLD
        else:
            path.frames_due = due = max(path.frames_due, due)
        epoch = path.epoch

        def arrive() -> None:
            if path.epoch == epoch:
                path.target.receive(frame)

        self._schedule(due, path.target, arrive)

    # -- delivery, without the lock

    def _apply_token(self, path: _Path, epoch: int, token: Token, present: bool) -> None:
        with self._changed:
            if path.epoch != epoch:
                return
            if present:
                path.applied[token] = None
            else:
                path.applied.pop(token, None)
        path.target.take_token(token, present)

    def _expiry(self, path: _Path, pair: frozenset[str], number: int) -> Callable[[], None]:
        def expire() -> None:
            with self._changed:
                if self._cuts.get(pair) != number:
                    return
                gone = sorted(path.applied, key=lambda token: not isinstance(token, HostToken))
                path.applied.clear()
                path.sent.clear()
            for token in gone:
                path.target.take_token(token, False)

        return expire

    def _due(self, target: float) -> tuple["MemoryNode", Callable[[], None]] | None:
        with self._changed:
            if not self._events or self._events[0][0] > target:
                return None
            due, _, node, action = heapq.heappop(self._events)
            if self._manual:
                self._now = max(self._now, due)
            self._busy = node
            return node, action

    def _run(self, node: "MemoryNode", action: Callable[[], None]) -> None:
        try:
            if not node.stopping.is_set():
                action()
        finally:
            with self._changed:
                self._busy = None
                self._changed.notify_all()

    def _deliver(self) -> None:
        while self._wait():
            event = self._due(monotonic())
            if event is None:
                continue
            try:
                self._run(*event)
            except BaseException:
                event[0].counters.add("panics")
                log.exception("a handler ended a delivery of the memory network")

    def _wait(self) -> bool:
        """Sleep until something falls due; False when the last node has left."""
        with self._changed:
            while self._nodes:
                pause = self._events[0][0] - monotonic() if self._events else None
                if pause is not None and pause <= 0.0:
                    return True
                self._changed.wait(pause)
            self._events.clear()
            self._thread = None
            self._changed.notify_all()
            return False


class MemoryNode(Node):
    """One start of a MemoryChannel."""

    def __init__(
        self, vehicle: str, own: Peer, handler: ChannelHandler, counters: Counters, network: MemoryNetwork
    ) -> None:
        self._network = network
        self.tokens: dict[Slot, Token] = {}  # the network's, under its lock
        super().__init__(vehicle, own, handler, counters)

    def open(self) -> None:
        self._network.join(self)
        self.announce_host()

    def close(self) -> None:
        self.stopping.set()
        self._network.leave(self)

    def clock_us(self) -> int:
        return round(self._network.now * 1e6) if self._network.manual else super().clock_us()

    def set_token(self, slot: Slot, token: Token | None) -> None:
        self._network.show(self, slot, token)

    def clear_subscriptions(self, peer: Peer) -> None:
        for slot in [s for s in list(self.tokens) if len(s) == 3 and s[2] == peer]:
            self._network.show(self, slot, None)

    def send(self, lane: Lane, parts: list[bytes] | None) -> None:
        for start in range(0, len(parts or ()), 2):
            frame = self.frame((parts or [])[start : start + 2])
            self.counters.add("sent_bytes", len(frame))
            self._network.transmit(self, lane.peer, frame)


class MemoryChannel(NodeChannel):
    """A Channel on a MemoryNetwork; made by `MemoryNetwork.channel`."""

    def __init__(self, network: MemoryNetwork) -> None:
        super().__init__()
        self._network = network

    def _make_node(self, vehicle: str, own: Peer, handler: ChannelHandler, counters: Counters) -> Node:
        return MemoryNode(vehicle, own, handler, counters, self._network)

    def _draw_id(self) -> str:
        return self._network.draw_id()
