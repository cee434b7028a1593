"""A handler that writes down what a channel tells it and can be waited for: for tests and tools."""

from collections.abc import Callable
from threading import Condition

from communicator.channel import Advert, Peer, SampleHeader

Event = tuple[object, ...]  # the verb without "process_", then its arguments


class Recorder:
    """A ChannelHandler; `events` is everything told so far, in order."""

    def __init__(self) -> None:
        self.events: list[Event] = []
        self._changed = Condition()

    def _note(self, *event: object) -> None:
        with self._changed:
            self.events.append(event)
            self._changed.notify_all()

    def named(self, verb: str) -> list[Event]:
        """Return the arguments of every call of one verb."""
        with self._changed:
            return [event[1:] for event in self.events if event[0] == verb]

    def wait(self, done: Callable[[list[Event]], object], timeout: float = 10.0) -> bool:
        """Wait until `done(events)` is true; return whether it became so."""
        with self._changed:
            return bool(self._changed.wait_for(lambda: done(self.events), timeout))

    def wait_for(self, *event: object, timeout: float = 10.0) -> bool:
        """Wait until exactly this event has been told; return whether it was."""
        return self.wait(lambda events: event in events, timeout)

    def clear(self) -> None:
        """Forget what has been told."""
        with self._changed:
            self.events.clear()

    def process_peer(self, peer: Peer, present: bool) -> None:
        self._note("peer", peer, present)

    def process_remote_topic(self, peer: Peer, advert: Advert, advertised: bool) -> None:
        self._note("remote_topic", peer, advert, advertised)

    def process_add_subscription(self, peer: Peer, topic: str, instance: int, interval_us: int) -> None:
        self._note("add_subscription", peer, topic, instance, interval_us)

    def process_remove_subscription(self, peer: Peer, topic: str, instance: int) -> None:
        self._note("remove_subscription", peer, topic, instance)

    def process_received_message(
        self, peer: Peer, topic: str, instance: int, header: SampleHeader, payload: bytes
    ) -> None:
        self._note("received_message", peer, topic, instance, header, payload)

    def process_control(self, peer: Peer, body: bytes) -> None:
        self._note("control", peer, body)
