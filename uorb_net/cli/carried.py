"""The bus a verb works on, with a link of the verb's own where the flags ask for one."""

import argparse
import logging
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from time import monotonic, sleep
from typing import TYPE_CHECKING

from ..broker.broker import Broker
from . import UsageError, complain
from .settings import Settings, carries_link, settings

if TYPE_CHECKING:
    from ..link import Link

LOOK = 0.02  # seconds between two looks at what only another host can change
QUIET = 0.4  # seconds without a new topic: then a peer has told what it has
PEER_WAIT = 5.0


class Bus:
    """A broker and, perhaps, its link."""

    def __init__(self, broker: Broker, link: "Link | None") -> None:
        self.broker = broker
        self.link = link
        self._up_since: float | None = None

    def peer_is_up(self) -> bool:
        """Tell whether the own link has reached a host."""
        up = self.link is not None and any(peer.state == "up" for peer in self.link.peers())
        if up and self._up_since is None:
            self._up_since = monotonic()
        return up

    def expects_news(self) -> bool:
        """Tell whether a peer may still be about to say what it has."""
        if self.link is None:
            return False
        return not self.peer_is_up() or monotonic() - (self._up_since or 0.0) < QUIET

    def wait_for_peer(self, seconds: float = PEER_WAIT) -> bool:
        """Wait until the own link has reached a host; True at once without a link."""
        return self.link is None or wait_until(self.peer_is_up, seconds)

    def settle(self, seconds: float = PEER_WAIT) -> None:
        """Wait until the peers have told what topics they have; nothing without a link."""
        if self.link is None:
            return
        if not self.wait_for_peer(seconds):
            complain("uorb", "no other host was reached: check the endpoints, and that the other side runs")
            return
        seen: list[object] = []
        since = monotonic()
        while monotonic() - since < QUIET:
            now: list[object] = [(s.topic, s.instance, s.advertised) for s in self.broker.topics()]
            if now != seen:
                seen, since = now, monotonic()
            sleep(LOOK)


def wait_until(condition: Callable[[], bool], seconds: float) -> bool:
    """Look until a condition holds, at most so long; True if it does."""
    deadline = monotonic() + seconds
    while not condition():
        if monotonic() >= deadline:
            return False
        sleep(LOOK)
    return True


@contextmanager
def opened(args: argparse.Namespace) -> Iterator[Bus]:
    """Open the bus that the flags name, and close it after use.

    Raises:
        UsageError: a flag or the configuration is wrong.
        LinkError: the bus has a link already, or an endpoint is in use.
    """
    if not carries_link(args):
        with open_broker(args.vehicle) as broker:
            yield Bus(broker, None)
        return
    chosen = settings(args)
    # Peers' coming and going is no news to who reads a topic; what the link refuses is told at the end.
    for name in ("uorb_net", "communicator"):
        logging.getLogger(name).setLevel(logging.ERROR)
    with open_broker(chosen.vehicle) as broker, make_link(broker, chosen) as link:
        try:
            yield Bus(broker, link)
        finally:
            _tell_events(link)


def open_broker(vehicle: str | None) -> Broker:
    """Open the bus of a vehicle; raises UsageError for a name that cannot be one."""
    try:
        return Broker(vehicle)
    except ValueError as error:
        raise UsageError(f"--vehicle: {error}") from error


def make_link(broker: Broker, chosen: Settings) -> "Link":
    """Return the link, not started; raises UsageError for settings that cannot be."""
    import msgspec

    from communicator import ChannelError, ZenohChannel

    from ..link import Link

    try:
        channel = ZenohChannel(
            listen=chosen.listen,
            connect=chosen.connect,
            mode=chosen.mode,
            lease=chosen.lease,
            tls=None if chosen.tls is None else msgspec.structs.asdict(chosen.tls),
            classes=msgspec.to_builtins(chosen.classes) or None,
        )
    except ChannelError as error:
        raise UsageError(str(error)) from error
    return Link(broker, channel, host=chosen.host)


def _tell_events(link: "Link") -> None:
    for event in link.events():
        if event.kind != "peer" and sys.stderr is not None:
            complain("uorb", f"{event.kind}: {event.text}")
