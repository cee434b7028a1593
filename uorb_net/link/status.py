"""What a link tells of itself: frozen values, read by tools, tests and users."""

import msgspec


class PeerStatus(msgspec.Struct, frozen=True, kw_only=True):
    """A host met at least once.

    `state`: "connecting" (seen, exchange not finished), "up", "degraded" (silent longer than it should
    be), "down", "refused". `since_us`: this host's clock at the last change of state. Seconds, None
    while unknown: `round_trip`; `clock_offset`, the peer's clock minus this host's; `clock_uncertainty`.
    """

    host: str
    state: str
    since_us: int
    round_trip: float | None = None
    clock_offset: float | None = None
    clock_uncertainty: float | None = None
    received: int = 0
    lost: int = 0


class LinkStats(msgspec.Struct, frozen=True, kw_only=True):
    """Totals since `start`. `sent_samples` counts transfers: one per peer and sample."""

    host: str
    vehicle: str
    state: str
    peers: int
    topics_out: int
    topics_in: int
    sent_samples: int
    sent_bytes: int
    received_samples: int
    received_bytes: int
    lost: int
    retransmitted: int
    malformed: int
    mismatched: int
    oversized: int
    thinned: int


class TopicLinkStats(msgspec.Struct, frozen=True, kw_only=True):
    """Totals of one remote topic instance, numbered as its origin numbers it."""

    topic: str
    instance: int
    origin: str
    received: int
    lost: int
    retransmitted: int
    thinned: int


class LinkEvent(msgspec.Struct, frozen=True, kw_only=True):
    """Something worth a line.

    `kind`: definition, peer, clash, malformed, oversized, instance, loss or config.
    """

    time_us: int
    kind: str
    peer: str
    topic: str
    text: str
