"""Running totals that any thread may add to."""

from threading import Lock

NAMES = (
    "sent_bytes",  # of frames, without Zenoh's own share
    "received_bytes",
    "malformed",  # frames and tokens that are not this wire's, or contradict what is known
    "oversized",  # samples and control messages above MAX_PAYLOAD, not sent
    "unknown",  # records of a peer or stream no token has announced
    "incompatible",  # links seen that speak another version of the wire
    "handler_errors",  # exceptions a handler let out
    "send_errors",  # puts and declarations that Zenoh refused
    "panics",  # Rust panics and the like that ended a round of one of our threads
    "resyncs",  # times the tokens were asked for anew, as their ring may have run over
)


class Counters:
    """The totals of one channel; they live through stop and start."""

    def __init__(self) -> None:
        self._lock = Lock()
        self._totals = dict.fromkeys(NAMES, 0)

    def add(self, name: str, amount: int = 1) -> int:
        """Add to one total and return it."""
        with self._lock:
            self._totals[name] += amount
            return self._totals[name]

    def snapshot(self) -> dict[str, int]:
        """Return a copy of all totals."""
        with self._lock:
            return dict(self._totals)
