"""Reads all that other hosts publish, through this host's bus alone, and keeps account of it."""

from collections.abc import Callable, Iterable
from typing import Any

from ..broker import Broker
from ..clock import hrt_absolute_time
from ..errors import UorbError
from ..link import TopicLinkStats
from ..subscription import Sample, Subscription
from .reports import Row

Listener = Callable[[Subscription[Any], Any], None]


class Feed:
    """One subscription and its account."""

    def __init__(self, subscription: Subscription[Any], origin: str) -> None:
        self.subscription = subscription
        self.origin = origin
        self.received = 0
        self._early = 0
        self._published_us = self._received_us = 0
        self._reported = (0, 0)  # `received` and the newest sample's time at the report before
        self._latency_us = self._timed = 0

    def take(self, sample: Sample[Any]) -> None:
        """Count a sample."""
        info = sample.info
        if not self.received:
            self._early = info.sequence - 1
        self.received += 1
        if not self._reported[1] and not info.latched:  # a latched sample's arrival says nothing of the rate
            self._reported = (self.received, info.received_us)
        self._published_us, self._received_us = info.published_us, info.received_us
        if info.published_us and not info.latched:
            self._latency_us += info.received_us - info.published_us
            self._timed += 1

    def row(self, net_lost: int) -> Row:
        """Return the account; rates begin anew."""
        count, since_us = self._reported
        span_us = self._received_us - since_us if since_us else 0
        if since_us:
            self._reported = (self.received, self._received_us)
        age_us = hrt_absolute_time() - self._published_us
        return Row(
            topic=self.subscription.topic,
            instance=self.subscription.instance,
            origin=self.origin,
            rate=(self.received - count) / span_us * 1e6 if span_us > 0 else 0.0,
            received=self.received,
            lost=self.subscription.lost,
            net_lost=net_lost,
            early=self._early,
            age=age_us / 1e6 if self._published_us else None,
            latency=self._latency_us / self._timed / 1e6 if self._timed else None,
        )


class Receiver:
    """Subscribes to whatever other hosts advertise on a bus, as it appears.

    Attributes:
        feeds: by topic and instance.
        subscriptions: theirs, to poll.
        listener: called with each sample's subscription and message.
    """

    def __init__(self, broker: Broker) -> None:
        self._broker = broker
        self.listener: Listener = lambda subscription, message: None
        self.feeds: dict[tuple[str, int], Feed] = {}
        self.subscriptions: list[Subscription[Any]] = []

    def look(self) -> None:
        """Subscribe to what is new."""
        own = self._broker.host
        for status in self._broker.topics():
            if status.advertised and status.origin != own and (status.topic, status.instance) not in self.feeds:
                subscription = self._broker.subscribe(
                    status.topic, status.instance, start="oldest", definition="publisher"
                )
                self.feeds[status.topic, status.instance] = Feed(subscription, status.origin)
                self.subscriptions.append(subscription)

    def take(self, subscription: Subscription[Any]) -> None:
        """Read all that is waiting."""
        feed = self.feeds[subscription.topic, subscription.instance]
        while subscription.check():
            try:
                sample = subscription.copy_with_info()
            except UorbError:
                return  # unadvertised at this moment
            feed.take(sample)
            self.listener(subscription, sample.message)

    def rows(self, stats: Iterable[TopicLinkStats]) -> list[Row]:
        """Return the account of every topic; `stats` tells what the link lost."""
        lost = self._net_lost(stats)
        return [feed.row(lost.get(key, 0)) for key, feed in sorted(self.feeds.items())]

    def _net_lost(self, stats: Iterable[TopicLinkStats]) -> dict[tuple[str, int], int]:
        """Return the link's losses by the numbers of this host.

        The link numbers instances as their own host does. One that was moved here got the lowest free
        number, so among one host's instances of a topic the order is the same on both sides.
        """
        there: dict[tuple[str, str], list[int]] = {}
        for stat in sorted(stats, key=lambda s: s.instance):
            there.setdefault((stat.topic, stat.origin), []).append(stat.lost)
        lost = {}
        for key, feed in sorted(self.feeds.items()):
            losses = there.get((key[0], feed.origin))
            if losses:
                lost[key] = losses.pop(0)
        return lost
