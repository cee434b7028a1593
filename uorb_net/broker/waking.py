"""What blocks and what wakes it: sleepers with a FIFO in each directory they wait in.

A sleeper announces itself in the tables of the nodes it waits for, looks again, and sleeps on its
descriptor; a publisher writes one byte to the FIFO of each armed sleeper. docs/node.md has the races.
"""

import os
import select
from typing import Protocol

from .descriptors import more_descriptors

DRAIN_EVERY = 16384  # wakes; a FIFO holds 64 KiB
# Seconds that a sleep lasts before the next look. The first is above the tick of a 250 Hz kernel: a shorter one
# makes each sleep program the timer hardware, which cost a quarter of a round trip on one CPU (measured).
LOOKS = (0.005, 0.02, 0.128, 1.0)


class End:
    """A sleeper's FIFO in one directory; publishers know it by `number`."""

    __slots__ = ("fd", "number", "path", "write_fd")

    def __init__(self, number: int, fd: int, write_fd: int, path: str = "") -> None:
        self.number = number
        self.fd = fd
        self.write_fd = write_fd
        self.path = path

    def poke(self) -> None:
        """Wake whoever sleeps on this end."""
        poke(self.write_fd)

    def drain(self) -> None:
        """Take all bytes out."""
        try:
            while len(os.read(self.fd, 65536)) == 65536:
                pass
        except OSError:
            return  # empty, or closed with its directory while a thread slept on it

    def close(self) -> None:
        """Give up the descriptors and the name; a second call does nothing."""
        if self.fd < 0:
            return
        for fd in {self.fd, self.write_fd}:
            os.close(fd)
        self.fd = self.write_fd = -1  # a sleeper that still knows this end must not touch who gets the number next
        if self.path:
            try:
                os.unlink(self.path)
            except FileNotFoundError:
                return  # swept by another process that took this one for dead, or the folder went


class EndMaker(Protocol):
    """A directory, as far as a sleeper needs it."""

    closed: bool

    def new_end(self) -> End:
        """Make a FIFO that publishers of this directory can find by its number."""


def poke(fd: int) -> bool:
    """Write one byte; False if nobody can read it any more."""
    try:
        os.write(fd, b"\0")
    except BlockingIOError:
        return True  # full: its owner is awake, or has wakes enough waiting
    except OSError:
        return False
    return True


class Sleeper:
    """One epoll over a FIFO per directory, edge triggered: a wake costs no draining read."""

    __slots__ = ("_drain_every", "_epoll", "_poll", "_wakes", "ends")

    def __init__(self) -> None:
        self.ends: dict[EndMaker, End] = {}
        self._epoll = more_descriptors(select.epoll)
        self._poll = self._epoll.poll
        self._drain_every = DRAIN_EVERY  # wakes; 1 where the kernel gives no edges
        self._wakes = 0

    def end(self, directory: EndMaker) -> End:
        """Return this sleeper's end in `directory`, made when first asked for."""
        end = self.ends.get(directory)
        if end is None:
            end = self.ends[directory] = directory.new_end()
            if not self._gives_edges(end):
                self._drain_every = 1
            self._epoll.register(end.fd, select.EPOLLIN | (select.EPOLLET if self._drain_every > 1 else 0))
        return end

    def sleep(self, seconds: float) -> bool:
        """Sleep until a byte comes (True) or `seconds` have passed (False)."""
        if not self._poll(seconds, 1):  # room for one event: the default allocates for a thousand
            return False
        self._wakes += 1
        if self._wakes >= self._drain_every:
            self._wakes = 0
            for end in self.ends.values():
                end.drain()
        return True

    def forget(self, directory: EndMaker) -> None:
        """Drop the end in a directory that is being closed; closing it takes it out of the epoll."""
        self.ends.pop(directory, None)

    @staticmethod
    def _gives_edges(end: End) -> bool:
        """Tell whether a second byte into a FIFO that is not empty is an edge.

        Linux 5.5 to 5.13 had kernels where it was not; there the sleeper reads after each wake.
        """
        trial = more_descriptors(select.epoll)
        try:
            trial.register(end.fd, select.EPOLLIN | select.EPOLLET)
            for _ in range(2):
                end.poke()
                if not trial.poll(0):
                    return False
        finally:
            trial.close()
            end.drain()
        return True

    def leave_closed(self) -> None:
        """Close the ends in directories that were closed while a thread slept here."""
        for directory in [directory for directory in self.ends if directory.closed]:
            self.ends.pop(directory).close()


_idle: list[Sleeper] = []
_lent: list[Sleeper] = []  # every one ever lent, so also the idle


def take() -> Sleeper:
    """Borrow a sleeper for one wait: the one used last, so that its entries are in place already."""
    try:
        return _idle.pop()
    except IndexError:
        sleeper = Sleeper()
        _lent.append(sleeper)
        return sleeper


def give_back(sleeper: Sleeper) -> None:
    """Return a borrowed sleeper."""
    _idle.append(sleeper)


def forget_directory(directory: EndMaker) -> list[int]:
    """Drop the idle sleepers' ends in a directory that is being closed.

    Returns the numbers of the ends on which threads sleep. Closing those would take the wake-up back that
    tells the threads; they close them when they find out (`leave_closed`).
    """
    for sleeper in _idle:
        sleeper.forget(directory)
    return [sleeper.ends[directory].number for sleeper in _lent if directory in sleeper.ends]


def forget_all() -> None:
    """Drop every idle sleeper: a forked child must not touch its parent's."""
    _idle.clear()
    _lent.clear()


os.register_at_fork(after_in_child=forget_all)
