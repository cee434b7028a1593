"""What waits to be sent: records gathered into frames, per peer and traffic class.

Frames leave through a `send` function handed in, one at a time, by whichever thread flushes; no lock
is held meanwhile, and two threads that flush keep each lane's order.
"""

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from threading import Lock

from communicator.channel import Advert, Peer
from communicator.wire import BATCH_BYTES, FRAME_HEADER_BYTES, MAX_RECORDS

COMMAND, SENSOR, BULK = CLASSES = ("c", "s", "b")  # in the order they are sent
_BULK_BYTES = 16 << 10


def traffic_class(advert: Advert) -> str:
    """Return the class a topic's samples travel in: queued ones first, big ones last."""
    if advert.queue_length > 1:
        return COMMAND
    return BULK if advert.payload_length > _BULK_BYTES else SENSOR


@dataclass(slots=True, eq=False)
class Lane:
    """The way to one peer in one class. `link` is the sender's own: only `send` touches it."""

    peer: Peer
    traffic: str
    parts: list[bytes] = field(default_factory=list)
    size: int = FRAME_HEADER_BYTES
    records: int = 0
    link: object = None


# One frame's parts after the header; None: nothing more will come, let the lane go.
Work = tuple[Lane, list[bytes] | None]


class Outbox:
    """Queues records per peer and hands full frames, or on flush all of them, to `send`."""

    def __init__(self, send: Callable[[Lane, list[bytes] | None], None]) -> None:
        self._send = send
        self._lock = Lock()
        self._lanes: dict[Peer, dict[str, Lane]] = {}
        self._filled: dict[Lane, None] = {}
        self._ready: dict[str, deque[Work]] = {traffic: deque() for traffic in CLASSES}
        self._sending = False

    def add_peer(self, peer: Peer) -> None:
        """Accept records for `peer` from now on."""
        with self._lock:
            self._lanes.setdefault(peer, {traffic: Lane(peer, traffic) for traffic in CLASSES})

    def drop_peer(self, peer: Peer) -> None:
        """Forget what waits for `peer`, and let its lanes go."""
        with self._lock:
            for lane in self._lanes.pop(peer, {}).values():
                self._filled.pop(lane, None)
                self._ready[lane.traffic].append((lane, None))
        self._send_ready()

    def put(self, peer: Peer, traffic: str, head: bytes, body: bytes) -> None:
        """Queue one record; a frame that it fills is sent at once. Unknown peers get nothing."""
        size = len(head) + len(body)
        with self._lock:
            lanes = self._lanes.get(peer)
            if lanes is None:
                return
            lane = lanes[traffic]
            full = lane.records and (lane.size + size > BATCH_BYTES or lane.records == MAX_RECORDS)
            if full:
                self._seal(lane)
            lane.parts += (head, body)
            lane.size += size
            lane.records += 1
            self._filled[lane] = None
        if full:
            self._send_ready()

    def flush(self) -> None:
        """Send everything queued so far; returns at once if another thread is already at it."""
        with self._lock:
            for lane in self._filled:
                self._seal(lane)
            self._filled.clear()
        self._send_ready()

    def _seal(self, lane: Lane) -> None:
        self._ready[lane.traffic].append((lane, lane.parts))
        lane.parts, lane.size, lane.records = [], FRAME_HEADER_BYTES, 0

    def _send_ready(self) -> None:
        with self._lock:
            if self._sending:
                return  # that thread looks again before it ends, and so takes ours along
            self._sending = True
        while (work := self._next()) is not None:
            try:
                self._send(*work)
            except BaseException:
                with self._lock:
                    self._sending = False
                raise

    def _next(self) -> Work | None:
        with self._lock:
            for ready in self._ready.values():
                if ready:
                    return ready.popleft()
            self._sending = False
            return None
