"""Records leave in few frames, commands first, each lane in order, whoever flushes."""

from threading import Event, Thread

from communicator import Advert, Peer
from communicator.outbox import BULK, COMMAND, SENSOR, Lane, Outbox, traffic_class
from communicator.wire import BATCH_BYTES, FRAME_HEADER_BYTES, MAX_RECORDS

A = Peer("a", "00000000000000a1")
B = Peer("b", "00000000000000b1")
HEAD = b"h" * 8


class Sent:
    """Takes frames down as (host, class, bodies), None for a lane let go."""

    def __init__(self) -> None:
        self.frames: list[tuple[str, str, list[bytes] | None]] = []
        self.box = Outbox(self.send)
        self.box.add_peer(A)
        self.box.add_peer(B)

    def send(self, lane: Lane, parts: list[bytes] | None) -> None:
        self.frames.append((lane.peer.host, lane.traffic, None if parts is None else parts[1::2]))


def test_what_is_queued_leaves_in_one_frame_per_peer_and_class_commands_first() -> None:
    sent = Sent()
    for peer, traffic, body in ((A, BULK, b"1"), (A, SENSOR, b"2"), (B, COMMAND, b"3"), (A, SENSOR, b"4")):
        sent.box.put(peer, traffic, HEAD, body)
    assert sent.frames == []
    sent.box.flush()
    assert sent.frames == [("b", "c", [b"3"]), ("a", "s", [b"2", b"4"]), ("a", "b", [b"1"])]
    sent.box.flush()
    assert len(sent.frames) == 3


def test_a_full_frame_leaves_without_a_flush_and_stays_below_the_batch() -> None:
    sent = Sent()
    body = bytes(1000)
    for _ in range(100):
        sent.box.put(A, SENSOR, HEAD, body)
    assert sent.frames
    sent.box.flush()
    counts = [len(bodies or ()) for _, _, bodies in sent.frames]
    assert sum(counts) == 100
    assert max(counts) * 1008 + FRAME_HEADER_BYTES <= BATCH_BYTES


def test_a_large_sample_goes_alone() -> None:
    sent = Sent()
    for body in (b"small", bytes(1 << 20), b"after"):
        sent.box.put(A, SENSOR, HEAD, body)
    sent.box.flush()
    assert [len(bodies or ()) for _, _, bodies in sent.frames] == [1, 1, 1]


def test_a_frame_never_has_more_records_than_its_reader_takes() -> None:
    sent = Sent()
    for _ in range(MAX_RECORDS + 1):
        sent.box.put(A, COMMAND, b"", b"")
    sent.box.flush()
    assert [len(bodies or ()) for _, _, bodies in sent.frames] == [MAX_RECORDS, 1]


def test_unknown_and_dropped_peers_get_nothing() -> None:
    sent = Sent()
    sent.box.put(A, SENSOR, HEAD, b"lost")
    sent.box.drop_peer(A)
    sent.box.put(A, SENSOR, HEAD, b"late")
    sent.box.put(Peer("x", "0" * 16), SENSOR, HEAD, b"stray")
    sent.box.flush()
    assert sent.frames == [("a", traffic, None) for traffic in ("c", "s", "b")]


def test_one_thread_sends_for_all_and_order_is_kept() -> None:
    entered, go_on = Event(), Event()
    bodies: list[bytes] = []

    def send(lane: Lane, parts: list[bytes] | None) -> None:
        entered.set()
        assert go_on.wait(5)
        bodies.extend((parts or [])[1::2])

    box = Outbox(send)
    box.add_peer(A)
    box.put(A, COMMAND, HEAD, b"1")
    first = Thread(target=box.flush)
    first.start()
    assert entered.wait(5)
    box.put(A, COMMAND, HEAD, b"2")
    box.flush()  # returns at once: the first takes it along
    go_on.set()
    first.join(5)
    assert bodies == [b"1", b"2"]


def test_a_send_that_fails_leaves_the_box_usable() -> None:
    failures = [RuntimeError("once")]
    bodies: list[bytes] = []

    def send(lane: Lane, parts: list[bytes] | None) -> None:
        if failures:
            raise failures.pop()
        bodies.extend((parts or [])[1::2])

    box = Outbox(send)
    box.add_peer(A)
    for body in (b"1", b"2"):
        box.put(A, COMMAND, HEAD, body)
        try:
            box.flush()
        except RuntimeError:
            pass
    assert bodies == [b"2"]


def test_queued_topics_travel_as_commands_and_big_ones_as_bulk() -> None:
    def advert(length: int, queue: int) -> Advert:
        return Advert("t", 0, "T", "h", length, queue, 50, True)

    assert traffic_class(advert(100, 1)) == SENSOR
    assert traffic_class(advert(100, 2)) == COMMAND
    assert traffic_class(advert(1 << 20, 2)) == COMMAND
    assert traffic_class(advert(16 << 10, 1)) == SENSOR
    assert traffic_class(advert((16 << 10) + 1, 1)) == BULK
