"""One peer as its link's neighbour sees it: state, silence, clock."""

from collections import deque

from communicator import Peer

from ..clock import hrt_absolute_time
from .control import Pong
from .status import PeerStatus

OFFSETS_KEPT = 16  # measurements; the one with the smallest round trip among them counts


class PeerState:
    """State and clock of one host's link; a host that returns with a new id is the same peer."""

    def __init__(self, peer: Peer) -> None:
        self.peer = peer
        self.state = "connecting"
        self.since_us = hrt_absolute_time()
        self.heard_us = self.since_us
        self.received = 0
        self.lost = 0
        self._measured: deque[tuple[int, int]] = deque(maxlen=OFFSETS_KEPT)  # round trip, offset: µs
        self._best: tuple[int, int] | None = None

    def change(self, state: str) -> bool:
        """Enter a state; False if it is the present one."""
        if state == self.state:
            return False
        self.state = state
        self.since_us = hrt_absolute_time()
        return True

    def restart(self, peer: Peer) -> None:
        """Meet the host's new link: another id, perhaps another clock."""
        self.peer = peer
        self.heard_us = hrt_absolute_time()
        self._measured.clear()
        self._best = None

    def measure(self, pong: Pong, now_us: int) -> bool:
        """Take a clock measurement: the smallest round trip has the smallest error (NTP, RFC 5905).

        False for an answer that cannot be one.
        """
        round_trip = (now_us - pong.ping_us) - (pong.sent_us - pong.received_us)
        if not 0 <= round_trip <= 60_000_000 or pong.sent_us < pong.received_us:
            return False
        offset = ((pong.received_us - pong.ping_us) + (pong.sent_us - now_us)) // 2
        self._measured.append((round_trip, offset))
        self._best = min(self._measured)
        return True

    def local_us(self, remote_us: int) -> int:
        """Return a time of the peer's clock in this host's; 0 while the offset is unknown."""
        best = self._best
        return 0 if best is None else max(remote_us - best[1], 0)

    @property
    def measured(self) -> bool:
        """Whether the clock offset is known."""
        return self._best is not None

    def status(self) -> PeerStatus:
        """Return the state as users see it."""
        best = self._best
        return PeerStatus(
            host=self.peer.host,
            state=self.state,
            since_us=self.since_us,
            round_trip=None if best is None else best[0] / 1e6,
            clock_offset=None if best is None else best[1] / 1e6,
            clock_uncertainty=None if best is None else best[0] / 2e6,
            received=self.received,
            lost=self.lost,
        )
