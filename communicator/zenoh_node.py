"""One start of a ZenohChannel: its session, and the threads that read what Zenoh received.

Zenoh's own threads run nothing of ours: they fill rings. Three threads read frames, one per traffic
class, three follow tokens and one tells the handler about those. No lock is held across a Zenoh call.
"""

import logging
from collections.abc import Callable
from queue import Full, Queue
from threading import Thread, current_thread
from time import monotonic
from typing import TYPE_CHECKING

from communicator.channel import ChannelError, ChannelHandler, Peer
from communicator.counters import Counters
from communicator.node import Node, Slot
from communicator.outbox import BULK, CLASSES, COMMAND, SENSOR, Lane
from communicator.session import SessionOptions, open_session, zenoh_config
from communicator.token_reader import TokenReader
from communicator.token_writer import TokenWriter
from communicator.tokens import KINDS, Token, data_key, format_token
from communicator.wire import MAX_FRAME, WireError

if TYPE_CHECKING:
    import zenoh

log = logging.getLogger(__name__)
# Frames that may wait for their reader; a ring that runs over drops its oldest, and numbers show it.
RINGS = {COMMAND: 2048, SENSOR: 1024, BULK: 64}
_STOP_TIMEOUT = 1.9
_RETRY = 0.5
_NEWS = 1024

open_nodes: "set[ZenohNode]" = set()


class ZenohNode(Node):
    """Tokens are liveliness tokens, frames are put on the key of the peer they are for."""

    def __init__(
        self, vehicle: str, own: Peer, handler: ChannelHandler, counters: Counters, options: SessionOptions
    ) -> None:
        super().__init__(vehicle, own, handler, counters)
        self._options = options
        self._session: zenoh.Session | None = None
        self._threads: list[Thread] = []
        self._subscribers: list[zenoh.Subscriber[zenoh.handlers.Handler[zenoh.Sample]]] = []
        self._writer = TokenWriter(self._send_failed)
        self._news: Queue[tuple[Token, bool] | None] = Queue(_NEWS)

    # -- joining and leaving

    def open(self) -> None:
        config = zenoh_config(self._options, self.own.host)
        open_nodes.add(self)
        if self._options.mode == "client":
            self._thread("open", lambda: self._open_client(config))
        else:
            self._attach(open_session(config, self._options))

    def _open_client(self, config: "zenoh.Config") -> None:
        # A client cannot open now and connect later: it fails while no router answers.
        said = ""
        while not self.stopping.is_set():
            try:
                self._attach(open_session(config, self._options))
                return
            except ChannelError as error:
                if str(error) != said:
                    said = str(error)
                    log.info("not connected yet: %s", said)
            self.stopping.wait(_RETRY)

    def _attach(self, session: "zenoh.Session") -> None:
        self._session = session
        if self.stopping.is_set():  # stop() may have looked before the line above
            session.close()  # type: ignore[no-untyped-call]
            return
        for traffic in CLASSES:
            self._read_frames(session, traffic)
        self._thread("news", self._tell_news)
        for kind in KINDS:
            self._read_tokens(session, kind)
        # The host's token last: who sees it can count on being heard.
        self.announce_host()
        self._writer.attach(session.liveliness().declare_token)

    def close(self) -> None:
        deadline = monotonic() + _STOP_TIMEOUT
        self.stopping.set()
        open_nodes.discard(self)
        self._close_session(deadline)
        try:
            self._news.put_nowait(None)
        except Full:
            pass  # then its reader is awake, and looks at `stopping` next
        for thread in self._threads:  # a client's opener is the first, and may add the rest meanwhile
            if thread is not current_thread():
                thread.join(max(0.0, deadline - monotonic()))
                if thread.is_alive():
                    log.warning("%s has not ended; is a handler blocking?", thread.name)

    def _close_session(self, deadline: float) -> None:
        # Beside a silent link whose queues are full, Zenoh's close waits 10 s; those who hear us learn
        # of our leaving before it. Rings end, and with them their readers, as soon as it begins.
        session = self._session
        if session is None:
            return

        def leave() -> None:
            try:
                self._writer.set(("host",), None)
                session.close()  # type: ignore[no-untyped-call]
            except Exception as error:
                log.info("the session was not closed in order: %s", error)

        closing = Thread(target=leave, name="uorb-zenoh-close", daemon=True)
        closing.start()
        closing.join(max(0.0, deadline - 0.9 - monotonic()))

    def _thread(self, name: str, loop: Callable[[], None]) -> None:
        thread = Thread(target=self._keep_going, args=(loop,), name=f"uorb-zenoh-{name}", daemon=True)
        self._threads.append(thread)
        thread.start()

    def _keep_going(self, loop: Callable[[], None]) -> None:
        # A Rust panic is a BaseException, and must not end what the whole host depends on.
        while not self.stopping.is_set():
            try:
                loop()
                return
            except BaseException:
                if self.stopping.is_set():
                    return
                total = self.counters.add("panics")
                if total & (total - 1) == 0:
                    log.exception("a channel thread failed (%d so far) and goes on", total)
                self.stopping.wait(0.1)

    # -- frames

    def _read_frames(self, session: "zenoh.Session", traffic: str) -> None:
        import zenoh

        key = data_key(self.vehicle, traffic, self.own.instance_id)
        ring: zenoh.handlers.RingChannel[zenoh.Sample] = zenoh.handlers.RingChannel(RINGS[traffic])
        subscriber = session.declare_subscriber(key, ring, allowed_origin=zenoh.Locality.REMOTE)
        self._subscribers.append(subscriber)
        handler = subscriber.handler

        def loop() -> None:
            for sample in handler:
                payload = sample.payload
                if len(payload) > MAX_FRAME:
                    self.malformed(WireError("frame too long"))
                else:
                    self.receive(payload.to_bytes())

        self._thread(traffic, loop)

    def send(self, lane: Lane, parts: list[bytes] | None) -> None:
        import zenoh

        try:
            if parts is None:
                self._retire(lane)
                return
            publisher = lane.link if isinstance(lane.link, zenoh.Publisher) else self._declare(lane)
            frame = self.frame(parts)
            publisher.put(frame)
            self.counters.add("sent_bytes", len(frame))
        except Exception as error:
            self._send_failed(error)

    def _declare(self, lane: Lane) -> "zenoh.Publisher":
        import zenoh

        priority = {
            COMMAND: zenoh.Priority.INTERACTIVE_HIGH,
            SENSOR: zenoh.Priority.DATA,
            BULK: zenoh.Priority.DATA_LOW,
        }[lane.traffic]
        if self._session is None:
            raise ChannelError("not connected")
        lane.link = publisher = self._session.declare_publisher(
            data_key(self.vehicle, lane.traffic, lane.peer.instance_id),
            congestion_control=zenoh.CongestionControl.DROP,
            priority=priority,
            express=False,
            allowed_destination=zenoh.Locality.REMOTE,
        )
        return publisher

    def _retire(self, lane: Lane) -> None:
        import zenoh

        if isinstance(lane.link, zenoh.Publisher):
            lane.link.undeclare()  # type: ignore[no-untyped-call]
        lane.link = None

    def _send_failed(self, error: Exception) -> None:
        if self.stopping.is_set():
            return
        total = self.counters.add("send_errors")
        if total & (total - 1) == 0:
            log.warning("Zenoh refused to send or declare (%d so far): %s", total, error)

    # -- tokens

    def set_token(self, slot: Slot, token: Token | None) -> None:
        self._writer.set(slot, format_token(self.vehicle, token) if token is not None else None)

    def clear_subscriptions(self, peer: Peer) -> None:
        self._writer.clear(lambda slot: isinstance(slot, tuple) and len(slot) == 3 and slot[2] == peer)

    def _read_tokens(self, session: "zenoh.Session", kind: str) -> None:
        reader = TokenReader(self.vehicle, kind, self.own.instance_id, self._hand_over, self.counters, self.stopping)
        reader.attach(session)
        self._thread(kind, reader.read)

    def _hand_over(self, token: Token, present: bool) -> None:
        # Bounded, so that a slow handler backs up into the ring, which is resynchronised.
        while not self.stopping.is_set():
            try:
                self._news.put((token, present), timeout=0.2)
                return
            except Full:
                continue

    def _tell_news(self) -> None:
        while not self.stopping.is_set():
            item = self._news.get()
            if item is not None:
                self.take_token(*item)
