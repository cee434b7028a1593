"""One start of a channel: the verbs in terms of tokens and frames, whatever carries those.

A `Node` lives from start to stop. `NodeChannel` is the Channel that makes one at each start.
"""

import logging
import os
from abc import abstractmethod
from collections.abc import Callable, Mapping
from threading import Event, Lock
from time import monotonic_ns
from typing import ParamSpec

from communicator.channel import Advert, Channel, ChannelError, ChannelHandler, Peer, SampleHeader
from communicator.counters import Counters
from communicator.outbox import COMMAND, Lane, Outbox, traffic_class
from communicator.state import Directory, LocalTopics, News, PeerNews, Topic
from communicator.tokens import AdvertToken, HostToken, SubscriptionToken, Token, check_interval, check_name
from communicator.wire import (
    MAX_PAYLOAD,
    WIRE_VERSION,
    WireError,
    pack_control_header,
    pack_frame_header,
    pack_sample_header,
    parse_frame,
)

log = logging.getLogger(__name__)
_Args = ParamSpec("_Args")
_MAX_WITHHELD = 0xFFFFFFFF

# What a token is for. One slot has one token; setting another replaces it.
Slot = tuple[str] | tuple[str, Topic] | tuple[str, Topic, Peer]


class Node:
    """What `ZenohChannel` and `MemoryChannel` share; the abstract part is how tokens and frames travel."""

    def __init__(self, vehicle: str, own: Peer, handler: ChannelHandler, counters: Counters) -> None:
        self.vehicle = vehicle
        self.own = own
        self.handler = handler
        self.counters = counters
        self.stopping = Event()
        self.outbox = Outbox(self.send)
        self._source = bytes.fromhex(own.instance_id)
        self._local = LocalTopics()
        self._local_lock = Lock()
        self._routes: dict[Topic, tuple[int, str]] = {}
        self.directory = Directory(own.instance_id, self._local)

    @abstractmethod
    def open(self) -> None:
        """Join the network; raise ChannelError if that can never work."""

    @abstractmethod
    def close(self) -> None:
        """Leave it; no handler call comes after."""

    @abstractmethod
    def set_token(self, slot: Slot, token: Token | None) -> None:
        """Have this token in the slot, and no other."""

    @abstractmethod
    def clear_subscriptions(self, peer: Peer) -> None:
        """Have no token in any slot that names `peer`."""

    @abstractmethod
    def send(self, lane: Lane, parts: list[bytes] | None) -> None:
        """Send one frame's records, or let the lane go. Never called by two threads at once."""

    def clock_us(self) -> int:
        """Return this host's time base, that of `published_us`."""
        return monotonic_ns() // 1000

    # -- outward

    def announce_host(self) -> None:
        """Show that this link is there; once it can receive."""
        self.set_token(("host",), HostToken(self.own))

    def advertise(self, advert: Advert) -> None:
        """Announce a topic instance, in place of what was announced of it before."""
        topic = (advert.topic, advert.instance)
        with self._local_lock:
            stream = self._local.announce(advert)
            self._routes[topic] = (stream, traffic_class(advert))
        self.set_token(("adv", topic), AdvertToken(self.own, stream, advert))

    def unadvertise(self, topic: Topic) -> None:
        """Take the announcement back; the stream number stays, for samples already queued."""
        self.set_token(("adv", topic), None)

    def subscribe(self, peer: Peer, topic: Topic, interval_us: int) -> None:
        """Ask for a topic of a present peer; of an absent one, or for what it never had: nothing."""
        check_interval(interval_us)
        stream = self.directory.stream(peer, topic)
        if stream is None:
            return
        token = SubscriptionToken(peer.instance_id, self.own, stream, *topic, interval_us)
        self.set_token(("sub", topic, peer), token)
        if not self.directory.present(peer):  # it went between the two looks
            self.unsubscribe(peer, topic)

    def unsubscribe(self, peer: Peer, topic: Topic) -> None:
        """Stop asking."""
        self.set_token(("sub", topic, peer), None)

    def queue_sample(self, peer: Peer, topic: Topic, header: SampleHeader, payload: bytes) -> None:
        """Queue a sample in its topic's class."""
        route = self._routes.get(topic)
        if route is None:
            raise ChannelError(f"{topic[0]} {topic[1]} was never advertised on this channel")
        if len(payload) > MAX_PAYLOAD:
            self.counters.add("oversized")
            return
        self.outbox.put(peer, route[1], pack_sample_header(route[0], header, len(payload)), payload)

    def queue_control(self, peer: Peer, body: bytes) -> None:
        """Queue a control message among the commands."""
        if len(body) > MAX_PAYLOAD:
            self.counters.add("oversized")
            return
        self.outbox.put(peer, COMMAND, pack_control_header(len(body)), body)

    def frame(self, parts: list[bytes]) -> bytes:
        """Return a frame of these records, sent now."""
        return b"".join((pack_frame_header(self._source, self.clock_us()), *parts))

    # -- inward

    def take_token(self, token: Token, present: bool) -> None:
        """Take in a token's coming or going and tell the handler; one caller at a time."""
        if isinstance(token, HostToken) and token.version != WIRE_VERSION:
            self._incompatible(token, present)
            return
        try:
            news = self.directory.apply(token, present)
        except WireError as error:
            self.malformed(error)
            return
        for item in news:
            self._tell(item)

    def _incompatible(self, token: HostToken, present: bool) -> None:
        if present and token.peer != self.own:
            self.counters.add("incompatible")
            log.warning("%s speaks wire version %d, this host %d", token.peer, token.version, WIRE_VERSION)

    def _tell(self, news: News) -> None:
        if isinstance(news, PeerNews):
            log.info("peer %s %s", news.peer, "is there" if news.present else "is gone")
            if news.present:
                self.outbox.add_peer(news.peer)
            else:
                self.outbox.drop_peer(news.peer)
                self.clear_subscriptions(news.peer)
        self.call(news.deliver, self.handler)

    def receive(self, data: bytes) -> None:
        """Take one frame apart and hand its records over, if a token announced their sender."""
        self.counters.add("received_bytes", len(data))
        try:
            frame = parse_frame(data)
        except WireError as error:
            self.malformed(error)
            return
        source = self.directory.source(frame.source)
        if source is None:
            self.counters.add("unknown", len(frame.records))
            return
        for stream, header, body in frame.records:
            if header is None:
                self.call(self.handler.process_control, source.peer, body)
            elif (topic := source.topics.get(stream)) is not None:
                self.call(self.handler.process_received_message, source.peer, *topic, header, body)
            else:
                self.counters.add("unknown")

    def call(self, verb: Callable[_Args, None], *args: _Args.args, **kwargs: _Args.kwargs) -> None:
        """Call the handler, unless this node is stopping; what it raises is logged and counted."""
        if self.stopping.is_set():
            return
        try:
            verb(*args, **kwargs)
        except Exception:
            total = self.counters.add("handler_errors")
            if total & (total - 1) == 0:  # the 1st, 2nd, 4th, 8th ...: it may come with every sample
                log.exception("the channel's handler failed (%d so far)", total)

    def malformed(self, error: WireError) -> None:
        """Count what a stranger sent."""
        self.counters.add("malformed")
        log.debug("malformed: %s", error)


class NodeChannel(Channel):
    """A Channel that makes a new `Node` at each start and drops it at stop.

    After stop the verbs do nothing, as a link's threads may still be on their way out.
    """

    def __init__(self) -> None:
        self._handler: ChannelHandler | None = None
        self._node: Node | None = None
        self._counters = Counters()

    @abstractmethod
    def _make_node(self, vehicle: str, own: Peer, handler: ChannelHandler, counters: Counters) -> Node:
        """Return a node that is not open yet."""

    def _draw_id(self) -> str:
        return os.urandom(8).hex()

    def _started(self) -> Node:
        if self._node is None:
            raise ChannelError("the channel has not been started")
        return self._node

    def _running(self) -> Node | None:
        node = self._started()
        return None if node.stopping.is_set() else node

    def register_handler(self, handler: ChannelHandler) -> None:
        if self._handler is not None:
            raise ChannelError("the channel has a handler already")
        self._handler = handler

    def start(self, vehicle: str, host: str) -> None:
        check_name("vehicle", vehicle)
        check_name("host", host)
        if self._handler is None:
            raise ChannelError("register a handler before start")
        before = self._node
        if before is not None and not before.stopping.is_set():
            raise ChannelError("the channel has been started already")
        self._node = node = self._make_node(vehicle, Peer(host, self._draw_id()), self._handler, self._counters)
        try:
            node.open()
        except BaseException:
            node.close()
            self._node = before
            raise

    def stop(self) -> None:
        node = self._node
        if node is not None and not node.stopping.is_set():
            node.close()

    @property
    def own(self) -> Peer:
        return self._started().own

    def topic_advertised(self, advert: Advert) -> None:
        if (node := self._running()) is not None:
            node.advertise(advert)

    def topic_unadvertised(self, topic: str, instance: int) -> None:
        if (node := self._running()) is not None:
            node.unadvertise((topic, instance))

    def add_subscription(self, peer: Peer, topic: str, instance: int, interval_us: int) -> None:
        if (node := self._running()) is not None:
            node.subscribe(peer, (topic, instance), interval_us)

    def remove_subscription(self, peer: Peer, topic: str, instance: int) -> None:
        if (node := self._running()) is not None:
            node.unsubscribe(peer, (topic, instance))

    def send_message(self, peer: Peer, topic: str, instance: int, header: SampleHeader, payload: bytes) -> None:
        if (node := self._running()) is not None:
            node.queue_sample(peer, (topic, instance), header, payload)

    def send_control(self, peer: Peer, body: bytes) -> None:
        if (node := self._running()) is not None:
            node.queue_control(peer, body)

    def flush(self) -> None:
        if (node := self._running()) is not None:
            node.outbox.flush()

    def counters(self) -> Mapping[str, int]:
        return self._counters.snapshot()
