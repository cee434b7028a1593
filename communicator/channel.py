"""The seam between the bus and a network: PX4's uORBCommunicator verbs, and the values they carry.

A link calls a `Channel`; a channel calls its `ChannelHandler`. Both sides may be called from any
thread. A handler never blocks on the network, a channel never blocks on a subscriber, and neither
raises because of what the network did: it counts. Source of the verbs: PX4's uORBCommunicator.hpp;
docs/wire.md has the wire, and what the channel promises about the order of these calls.
"""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol


class ChannelError(Exception):
    """The channel cannot be opened as configured: a bad endpoint, a port in use, a wrong option."""


@dataclass(frozen=True, slots=True)
class Peer:
    """Another host's link: a name, and the id it drew when it started (16 hex digits)."""

    host: str
    instance_id: str


@dataclass(frozen=True, slots=True)
class Advert:
    """One advertised topic instance, as its own host numbers it.

    `type_hash` is RIHS01; `payload_length` counts encoded bytes with the 4-byte encapsulation
    header; `shared` tells instance 0 made with advertise from one publisher's own instance.
    """

    topic: str
    instance: int
    type_name: str
    type_hash: str
    payload_length: int
    queue_length: int
    priority: int
    shared: bool


@dataclass(frozen=True, slots=True)
class SampleHeader:
    """What travels with a sample's bytes.

    `sequence` numbers the publications of (host, topic, instance) from 1; `withheld` says how many
    publications right before this one a rate limit kept back; `published_us` is the sender's
    CLOCK_MONOTONIC; `age_us`, filled in by the receiving channel, the time between publication and sending.
    """

    sequence: int
    published_us: int
    age_us: int = 0
    withheld: int = 0
    latched: bool = False


class ChannelHandler(Protocol):
    """What a channel calls when the network has news.

    News of peers, topics and subscriptions comes one call at a time, a peer before all else of it.
    Samples and control messages come on other threads, and may run beside news. An exception is logged
    and counted, and changes nothing.
    """

    def process_peer(self, peer: Peer, present: bool) -> None:
        """A peer's link was seen; or it is gone, and with it its adverts, its subscriptions and ours to it.

        Nothing is withdrawn one by one then. A peer that returns is announced with all it has, and is
        asked again for what is wanted of it.
        """

    def process_remote_topic(self, peer: Peer, advert: Advert, advertised: bool) -> None:
        """A peer advertises a topic instance, in place of an earlier advert of it; or takes that back."""

    def process_add_subscription(self, peer: Peer, topic: str, instance: int, interval_us: int) -> None:
        """A peer wants this host's topic instance, at most every `interval_us` (0: every sample).

        Again with another interval: the rate changed. A sample sent from here on arrives or is lost as
        any other; it does not come too early.
        """

    def process_remove_subscription(self, peer: Peer, topic: str, instance: int) -> None:
        """The peer wants it no more."""

    def process_received_message(
        self, peer: Peer, topic: str, instance: int, header: SampleHeader, payload: bytes
    ) -> None:
        """A sample of the peer's topic instance, numbered as the peer numbers it.

        It may come after the advert was taken back, which it then has been overtaken by.
        """

    def process_control(self, peer: Peer, body: bytes) -> None:
        """A control message of the peer's link; may be lost or doubled like any other.

        One sent right after process_peer is lost if the peer has not yet seen this host: repeat it.
        """


class Channel(ABC):
    """What a link calls. One channel serves one link."""

    @abstractmethod
    def register_handler(self, handler: ChannelHandler) -> None:
        """Name the receiver of all news; once, before start."""

    @abstractmethod
    def start(self, vehicle: str, host: str) -> None:
        """Join the network as `host` of `vehicle`; return at once, whether or not anyone is there.

        Raises:
            ChannelError: the configuration cannot work, whatever the network does.
        """

    @abstractmethod
    def stop(self) -> None:
        """Leave within 2 s; no handler call comes after it and no thread stays."""

    @property
    @abstractmethod
    def own(self) -> Peer:
        """This link as its peers see it; the id is drawn anew by each start."""

    @abstractmethod
    def topic_advertised(self, advert: Advert) -> None:
        """Announce a local topic instance to every peer, present and future; again: replace it.

        Raises:
            ChannelError: a field cannot travel (docs/wire.md has the limits).
        """

    @abstractmethod
    def topic_unadvertised(self, topic: str, instance: int) -> None:
        """Take the announcement back."""

    @abstractmethod
    def add_subscription(self, peer: Peer, topic: str, instance: int, interval_us: int) -> None:
        """Ask `peer` for its topic instance; again with another interval: change the rate.

        Nothing happens for a peer that is not there or never advertised it.
        """

    @abstractmethod
    def remove_subscription(self, peer: Peer, topic: str, instance: int) -> None:
        """Stop asking."""

    @abstractmethod
    def send_message(self, peer: Peer, topic: str, instance: int, header: SampleHeader, payload: bytes) -> None:
        """Queue one sample of a local, advertised topic instance for `peer`; `flush` sends it.

        A full frame leaves at once. Nothing happens for a peer that is not there.

        Raises:
            ChannelError: the topic instance was never advertised on this channel.
            ValueError: a number of the header does not fit its field.
        """

    @abstractmethod
    def send_control(self, peer: Peer, body: bytes) -> None:
        """Queue one control message of the link's for `peer`; `flush` sends it."""

    @abstractmethod
    def flush(self) -> None:
        """Send what is queued, as few packets as it fits in. Never blocks on a peer."""

    @abstractmethod
    def counters(self) -> Mapping[str, int]:
        """Running totals: sent_bytes, received_bytes, malformed, oversized; more in counters.py."""
