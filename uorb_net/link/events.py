"""A link's newest events, each also a log line, floods held back."""

from collections import deque
from logging import getLogger

from ..clock import hrt_absolute_time
from .status import LinkEvent

KEPT = 1000
QUIET_US = 1_000_000  # between two log lines of one kind, peer and topic

log = getLogger("uorb_net.link")


class Events:
    """The newest events; appended by any thread."""

    def __init__(self, host: str) -> None:
        self._host = host
        self._kept: deque[LinkEvent] = deque(maxlen=KEPT)
        self._said: dict[tuple[str, str, str], int] = {}

    def add(self, kind: str, text: str, *, peer: str = "", topic: str = "") -> None:
        """Keep an event and log it, at most one line a second of its kind, peer, topic and text."""
        now = hrt_absolute_time()
        self._kept.append(LinkEvent(time_us=now, kind=kind, peer=peer, topic=topic, text=text))
        key = (kind, peer, text)
        if now - self._said.get(key, -QUIET_US) >= QUIET_US:
            if len(self._said) > KEPT:
                self._said.clear()
            self._said[key] = now
            log.warning("%s: %s: %s", self._host, kind, text)

    def list(self) -> list[LinkEvent]:
        """Return the newest events, oldest first."""
        return list(self._kept)
