"""Follows one kind of tokens over a Zenoh session and says which came and which went.

Token events arrive in a ring, which never stalls the link but drops its oldest when it runs over, and
does not say so. A lost event would leave a wrong picture for good. A run-over ring is a full one, so its
reader takes that many events without once finding it empty: after such a run it asks for all tokens.
"""

import logging
from collections.abc import Callable
from threading import Event
from typing import TYPE_CHECKING

from communicator.counters import Counters
from communicator.tokens import Token, parse_token, token_filter
from communicator.wire import WireError

if TYPE_CHECKING:
    import zenoh

log = logging.getLogger(__name__)
RING = 65_536  # events that may wait; Zenoh takes the memory as they come
MAX_TOKENS = 65_536  # of one kind, of all hosts together
_ASK_TIMEOUT = 2.0
_ANSWERS = 4096
_ASK_AGAIN = 1.0


class TokenReader:
    """The set of one kind's tokens; `emit(token, present)` gets every change of it.

    `emit` may block: it holds up this reader only.
    """

    def __init__(
        self,
        vehicle: str,
        kind: str,
        own_id: str,
        emit: Callable[[Token, bool], None],
        counters: Counters,
        stopping: Event,
    ) -> None:
        self.kind = kind
        self._vehicle = vehicle
        self._filter = token_filter(vehicle, kind, own_id)
        self._emit = emit
        self._counters = counters
        self._stopping = stopping
        self._known: dict[str, Token] = {}
        self._ring_size = RING

    def attach(self, session: "zenoh.Session") -> None:
        """Subscribe; tokens already there are reported too."""
        import zenoh

        self._session = session
        self._put = zenoh.SampleKind.PUT
        ring: zenoh.handlers.RingChannel[zenoh.Sample] = zenoh.handlers.RingChannel(self._ring_size)
        self._subscriber = session.liveliness().declare_subscriber(self._filter, ring, history=True)

    def read(self) -> None:
        """Follow until the session closes, which raises ZError."""
        ring = self._subscriber.handler
        run = 0
        while True:
            sample = ring.try_recv()
            if sample is None:
                if run >= self._ring_size // 2:
                    self.resync()
                run = 0
                sample = ring.recv()
            run += 1
            self._take(str(sample.key_expr), sample.kind == self._put)

    def resync(self) -> None:
        """Ask who is there and report what differs.

        An answer may be incomplete, soon after a connection above all: only what two answers in a
        row lack is gone. Events still in the ring are taken after this, and each is the last word on
        its token.
        """
        self._counters.add("resyncs")
        log.warning("the ring of %s tokens may have run over; asking for them anew", self.kind)
        absent: set[str] | None = None
        for pause in (0.0, _ASK_AGAIN):
            if self._stopping.wait(pause):
                return
            listed = self._ask()
            for key in listed:
                self._take(key, True)
            missing = self._known.keys() - listed
            absent = missing if absent is None else absent & missing
        for key in absent or ():
            self._take(key, False)

    def _ask(self) -> set[str]:
        import zenoh

        # A FIFO, though a full one stalls the link: a ring loses its content with the last reply, and
        # nothing but this loop reads between the first and that.
        fifo: zenoh.handlers.FifoChannel[zenoh.Reply] = zenoh.handlers.FifoChannel(_ANSWERS)
        replies = self._session.liveliness().get(self._filter, fifo, timeout=_ASK_TIMEOUT)
        listed, complete = set[str](), True
        for reply in replies:
            if reply.ok is not None:
                listed.add(str(reply.ok.key_expr))
            else:
                complete = False
        return listed if complete else listed | self._known.keys()

    def _take(self, key: str, present: bool) -> None:
        known = self._known.get(key)
        if present == (known is not None):
            return
        if known is not None:
            del self._known[key]
            self._emit(known, False)
            return
        try:
            token = parse_token(self._vehicle, key)
            if len(self._known) >= MAX_TOKENS:
                raise WireError("too many tokens")
        except WireError as error:
            self._counters.add("malformed")
            log.debug("malformed: %s", error)
            return
        self._known[key] = token
        self._emit(token, True)
