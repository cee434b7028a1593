"""Telling a service manager how the process is doing: systemd's sd_notify(3), a datagram to a socket."""

import os
import socket
from contextlib import suppress
from time import monotonic


class Notifier:
    """Sends states to `$NOTIFY_SOCKET`; does nothing where there is none."""

    def __init__(self) -> None:
        self._address = os.environ.get("NOTIFY_SOCKET", "")
        if self._address.startswith("@"):  # Linux's abstract names
            self._address = "\0" + self._address[1:]
        self._period = _watchdog_seconds() / 2
        self._fed = -self._period

    def send(self, state: str) -> None:
        """Send a state, such as `READY=1`; what nobody takes is lost."""
        if not self._address:
            return
        with (
            suppress(OSError),
            socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC) as sock,
        ):
            sock.settimeout(0.5)
            sock.connect(self._address)
            sock.send(state.encode())

    def feed(self) -> None:
        """Tell the watchdog that all is well, if it is there and due."""
        if self._period and monotonic() - self._fed >= self._period:
            self._fed = monotonic()
            self.send("WATCHDOG=1")

    def nap(self, longest: float) -> float:
        """Return the seconds until the watchdog must be fed, at most `longest`."""
        return min(longest, self._period / 2) if self._period else longest


def _watchdog_seconds() -> float:
    """Return the watchdog's limit; 0 without one, or where it means another process."""
    if os.environ.get("WATCHDOG_PID", str(os.getpid())) != str(os.getpid()):
        return 0.0
    try:
        return max(int(os.environ.get("WATCHDOG_USEC", "0")), 0) / 1e6
    except ValueError:
        return 0.0
