"""A mirror's books: heads that overtake samples, first and last samples that are lost, gaps asked for once."""

from collections.abc import Iterator
from typing import Any

import pytest

import uorb_net as uorb
from communicator import Advert, Peer, SampleHeader
from uorb_net.broker import members
from uorb_net.link import incoming
from uorb_net.link.incoming import Mirror
from uorb_net.link.peers import PeerState
from uorb_net.msg import VehicleAttitude

KIND = VehicleAttitude.__uorb__


class Books:
    """A mirror on a private bus, its clock, and what it asked for."""

    def __init__(self, queue_length: int, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now = 100.0
        monkeypatch.setattr(incoming, "monotonic", lambda: self.now)
        self.broker = uorb.Broker.private()
        advert = Advert("vehicle_attitude", 0, KIND.name, KIND.type_hash, KIND.payload_length, queue_length, 75, True)
        self.mirror = Mirror(PeerState(Peer("far", "0" * 16)), advert)
        self.mirror.node = members.advertise(
            self.broker._directory, KIND, "vehicle_attitude", 0, priority=75, queue_length=queue_length, host="far"
        )
        self.asked: list[tuple[int, int]] = []
        self.mirror.begin()

    def receive(self, *numbers: int, withheld: int = 0) -> None:
        """Let samples arrive."""
        for number in numbers:
            payload = KIND.encode(VehicleAttitude(timestamp=number), 0)
            assert self.mirror.receive(SampleHeader(number, 1, 0, withheld), payload, self._ask)

    def _ask(self, mirror: Mirror, first: int, last: int) -> None:
        self.asked.append((first, last))

    def later(self, seconds: float) -> None:
        """Let time pass, and the link look after the mirror."""
        self.now += seconds
        self.mirror.look_after(self.now, self._ask)

    @property
    def counted(self) -> tuple[int, int]:
        """Received and lost."""
        return self.mirror.received, self.mirror.lost


@pytest.fixture(params=[1, 16])
def books(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Iterator[Books]:
    """The books of a topic with and without a queue."""
    made = Books(request.param, monkeypatch)
    yield made
    made.broker.close()


def test_a_head_that_overtakes_its_sample_costs_nothing(books: Books) -> None:
    """It travels in another class; the sample a moment later is taken."""
    books.mirror.head(4, 5)
    books.receive(5)
    books.later(1.0)
    assert books.counted == (1, 0)
    assert books.asked == []


def test_a_lost_last_sample_is_asked_for_and_then_counted(books: Books) -> None:
    """The newest is worth asking for whatever the queue; without an answer it is lost."""
    books.receive(1)
    books.mirror.head(0, 3)
    books.later(0.01)
    assert books.asked == []
    books.later(0.2)
    assert books.asked == [(3, 3) if books.mirror.advert.queue_length == 1 else (2, 3)]
    books.later(0.6)
    assert books.counted == (1, 2)
    books.receive(4)
    assert books.counted == (2, 2)


def test_an_asked_for_sample_that_comes_is_no_loss(books: Books) -> None:
    """The answer is taken like any other."""
    books.receive(1)
    books.mirror.head(0, 2)
    books.later(0.2)
    books.receive(2)
    books.later(1.0)
    assert books.counted == (2, 0)
    assert books.mirror.retransmitted == 1


def test_a_lost_first_sample_shows_in_the_base(books: Books) -> None:
    """The first to come sets the base for the time being; the head tells what was owed before it."""
    books.receive(7)
    assert books.counted == (1, 0)
    books.mirror.head(4, 7)
    assert books.counted == (1, 2)
    books.mirror.head(4, 7)
    assert books.counted == (1, 2), "counted once"


def test_what_an_interval_withheld_is_no_loss(books: Books) -> None:
    """Told along with the sample, it is thinned."""
    books.receive(1)
    books.receive(10, withheld=8)
    assert books.counted == (2, 0)
    assert books.mirror.thinned == 8


def test_a_gap_in_a_queue_is_filled_in_order(monkeypatch: pytest.MonkeyPatch) -> None:
    """What came after the gap waits; doubles change nothing."""
    books = Books(16, monkeypatch)
    with books.broker, books.broker.subscribe(VehicleAttitude) as subscription:
        books.receive(1, 4, 5, 4)
        assert books.asked == [(2, 3)]
        books.receive(3, 2, 2)
        got = [m.timestamp for m in iter(subscription.update, None)]
        assert got == [1, 2, 3, 4, 5]
        assert books.counted == (5, 0)


def test_bytes_that_cannot_be_the_topics_are_refused(books: Books) -> None:
    """Wrong length or header: false, and nothing is written."""
    header = SampleHeader(1, 1)
    for payload in (b"", b"\0\1\0\0", bytes(KIND.payload_length), bytes(KIND.payload_length + 1)):
        assert not books.mirror.receive(header, payload, lambda *_: None)
    assert books.counted == (0, 0)
    good: Any = KIND.encode(VehicleAttitude(), 0)
    assert books.mirror.receive(header, good, lambda *_: None)
