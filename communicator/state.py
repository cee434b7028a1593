"""What a channel knows of its peers, made from tokens that come in any order. No I/O, no locks.

`Directory.apply` has one caller at a time; `Directory.source` may be read from any thread.
"""

from dataclasses import dataclass, field

from communicator.channel import Advert, ChannelError, ChannelHandler, Peer
from communicator.tokens import (
    MAX_STREAM,
    AdvertToken,
    HostToken,
    SubscriptionToken,
    Token,
    check_advert,
)
from communicator.wire import WIRE_VERSION, WireError

Topic = tuple[str, int]  # name and instance


@dataclass(frozen=True, slots=True)
class PeerNews:
    """A peer came, or went with all it announced."""

    peer: Peer
    present: bool

    def deliver(self, handler: ChannelHandler) -> None:
        """Tell the handler."""
        handler.process_peer(self.peer, self.present)


@dataclass(frozen=True, slots=True)
class TopicNews:
    """A peer advertises this now, in place of what it advertised before; or takes it back."""

    peer: Peer
    advert: Advert
    advertised: bool

    def deliver(self, handler: ChannelHandler) -> None:
        """Tell the handler."""
        handler.process_remote_topic(self.peer, self.advert, self.advertised)


@dataclass(frozen=True, slots=True)
class SubscriptionNews:
    """A peer wants a topic instance at this rate; `interval_us` None: no more."""

    peer: Peer
    topic: Topic
    interval_us: int | None

    def deliver(self, handler: ChannelHandler) -> None:
        """Tell the handler."""
        if self.interval_us is None:
            handler.process_remove_subscription(self.peer, *self.topic)
        else:
            handler.process_add_subscription(self.peer, *self.topic, self.interval_us)


News = PeerNews | TopicNews | SubscriptionNews


@dataclass(frozen=True, slots=True)
class Source:
    """A present peer as the sender of data: who it is, and what its stream numbers mean.

    Names stay after an unadvertisement, as data may be overtaken by it, and go with the peer.
    """

    peer: Peer
    topics: dict[int, Topic]


@dataclass(slots=True)
class _Known:
    """The tokens of one peer. An inner dict is an ordered set: its last key is the newest advert."""

    present: bool = False
    topics: dict[int, Topic] = field(default_factory=dict)
    streams: dict[Topic, int] = field(default_factory=dict)
    adverts: dict[int, dict[Advert, None]] = field(default_factory=dict)
    intervals: dict[int, set[int]] = field(default_factory=dict)


class LocalTopics:
    """Numbers a link's own topic instances; a number is never given to a second one.

    `announce` has one caller at a time; the rest may be read from any thread.
    """

    def __init__(self) -> None:
        self._streams: dict[Topic, int] = {}
        self._topics: list[Topic] = []

    def announce(self, advert: Advert) -> int:
        """Return the stream number of the advert's topic instance, a new one if it has none.

        Raises:
            ChannelError: a field cannot travel, or no number is left.
        """
        topic = (check_advert(advert).topic, advert.instance)
        stream = self._streams.get(topic)
        if stream is None:
            stream = len(self._topics)
            if stream > MAX_STREAM:
                raise ChannelError(f"more than {MAX_STREAM + 1} topic instances since start")
            self._topics.append(topic)
            self._streams[topic] = stream
        return stream

    def stream(self, topic: Topic) -> int | None:
        """Return the topic's number if it ever had one."""
        return self._streams.get(topic)

    def topic(self, stream: int) -> Topic | None:
        """Return the topic that has this number."""
        return self._topics[stream] if stream < len(self._topics) else None


class Directory:
    """The peers of the link `own_id`: who is present, what they advertise, what they want of it."""

    def __init__(self, own_id: str, local: LocalTopics) -> None:
        self._own_id = own_id
        self._local = local
        self._known: dict[Peer, _Known] = {}
        self._sources: dict[bytes, Source] = {}

    def source(self, instance_id: bytes) -> Source | None:
        """Return the present peer that has this 8-byte id."""
        return self._sources.get(instance_id)

    def present(self, peer: Peer) -> bool:
        """Tell whether the peer's link is there."""
        known = self._known.get(peer)
        return known is not None and known.present

    def stream(self, peer: Peer, topic: Topic) -> int | None:
        """Return the number a present peer gave a topic it has advertised."""
        known = self._known.get(peer)
        return known.streams.get(topic) if known is not None and known.present else None

    def apply(self, token: Token, present: bool) -> list[News]:
        """Take in that a token is there or gone; return what that means, in order.

        A token seen twice, or gone without having been seen, means nothing.

        Raises:
            WireError: the token contradicts another, or what this host announced.
        """
        if token.peer.instance_id == self._own_id:
            return []
        known = self._known.get(token.peer)
        if known is None:
            if not present:
                return []
            known = _Known()
        match token:
            case HostToken():
                news = self._apply_host(token, known, present)
            case AdvertToken():
                news = self._apply_advert(token, known, present)
            case SubscriptionToken():
                news = self._apply_subscription(token, known, present)
        self._keep(token.peer, known)
        return news

    def _keep(self, peer: Peer, known: _Known) -> None:
        if known.present or known.adverts or known.intervals:
            self._known[peer] = known
        else:
            self._known.pop(peer, None)

    def _apply_host(self, token: HostToken, known: _Known, present: bool) -> list[News]:
        if token.version != WIRE_VERSION or present == known.present:
            return []
        instance_id = bytes.fromhex(token.peer.instance_id)
        if not present:
            known.present = False
            del self._sources[instance_id]
            return [PeerNews(token.peer, False)]
        if instance_id in self._sources:
            raise WireError(f"id {token.peer.instance_id} of two hosts")
        known.present = True
        self._sources[instance_id] = Source(token.peer, known.topics)
        return self._introduce(token.peer, known)

    def _apply_advert(self, token: AdvertToken, known: _Known, present: bool) -> list[News]:
        adverts = known.adverts.get(token.stream, {})
        before = _last(adverts)
        if present:
            _name_stream(known, token)
            adverts.setdefault(token.advert)
            known.adverts[token.stream] = adverts
        else:
            adverts.pop(token.advert, None)
            if not adverts:
                known.adverts.pop(token.stream, None)
        after = _last(adverts)
        if not known.present or before == after:
            return []
        shown = after or before
        return [TopicNews(token.peer, shown, after is not None)] if shown else []

    def _apply_subscription(self, token: SubscriptionToken, known: _Known, present: bool) -> list[News]:
        topic = (token.topic, token.instance)
        if token.publisher_id != self._own_id or self._local.topic(token.stream) != topic:
            if not present:
                return []
            raise WireError("subscription to what this host never announced")
        intervals = known.intervals.get(token.stream, set())
        before = min(intervals, default=None)
        if present:
            intervals.add(token.interval_us)
            known.intervals[token.stream] = intervals
        else:
            intervals.discard(token.interval_us)
            if not intervals:
                known.intervals.pop(token.stream, None)
        after = min(intervals, default=None)
        if not known.present or before == after:
            return []
        return [SubscriptionNews(token.peer, topic, after)]

    def _introduce(self, peer: Peer, known: _Known) -> list[News]:
        """Return a peer's presence, then its adverts, then what it wants of this host."""
        news: list[News] = [PeerNews(peer, True)]
        news += [TopicNews(peer, next(reversed(adverts)), True) for adverts in known.adverts.values()]
        for stream, intervals in known.intervals.items():
            topic = self._local.topic(stream)
            if topic is not None:
                news.append(SubscriptionNews(peer, topic, min(intervals)))
        return news


def _name_stream(known: _Known, token: AdvertToken) -> None:
    topic = (token.advert.topic, token.advert.instance)
    named = known.topics.get(token.stream)
    if named != topic and (named is not None or topic in known.streams):
        raise WireError(f"stream {token.stream} and {topic} are not one to one")
    known.topics[token.stream] = topic
    known.streams[topic] = token.stream


def _last(adverts: dict[Advert, None]) -> Advert | None:
    return next(reversed(adverts), None)
