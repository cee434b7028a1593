"""A subscription's file descriptor: readable while an update is pending, for select, selectors, asyncio.

Publishers put a byte into an armed FIFO; `settle`, after each copy, takes it out or leaves it. What no
publication announces (an interval that passes, a publisher that died) needs someone awake here: one
timekeeper thread per process, started by the first descriptor and by nothing else.
"""

import os
from collections.abc import Callable
from contextlib import suppress
from threading import Condition, Thread
from typing import TYPE_CHECKING, Any

from .errors import ClosedError, UorbError

if TYPE_CHECKING:
    from asyncio import AbstractEventLoop

    from .subscription import Subscription

LOOK = 1.0  # seconds: how late a death, or a wake-up lost with its publisher, may show


class Exported:
    """The readable end of one subscription."""

    def __init__(self, subscription: "Subscription[Any]") -> None:
        self._subscription = subscription
        self._directory = subscription._node.directory
        self.end = self._directory.new_end()
        self.closed = False
        self.waiting: set[tuple[AbstractEventLoop, Callable[[], None]]] = set()  # tasks, each with its waker
        self.settle()
        _timekeeper.add(self)

    def settle(self) -> None:
        """Make the descriptor say what `check` says."""
        subscription = self._subscription
        if not subscription.check():
            self.end.drain()
            words = subscription._node.mapping.words
            if subscription.rest():  # armed now, it would be readable before the interval has passed
                self._directory.disarm(words, self.end.number)
                _timekeeper.hurry()
                return
            self._directory.arm(words, self.end.number)
            if not subscription.check():
                return
        self.end.drain()
        self.end.poke()

    def due_in(self) -> float:
        """Return the seconds until the timekeeper must look here."""
        try:
            return min(self._subscription.rest() or LOOK, LOOK)
        except ClosedError:
            return 0.0

    def close(self) -> None:
        """Give the descriptor up."""
        self.closed = True
        _timekeeper.remove(self)
        for loop, wake in list(self.waiting):
            with suppress(RuntimeError):  # a loop that has ended
                loop.call_soon_threadsafe(wake)
        self._directory.drop_end(self.end)


class _Timekeeper:
    """Settles every exported descriptor when its time comes."""

    def __init__(self) -> None:
        self._changed = Condition()
        self._exported: set[Exported] = set()
        self._thread: Thread | None = None

    def add(self, exported: Exported) -> None:
        """Care for a descriptor from now on."""
        with self._changed:
            self._exported.add(exported)
            if self._thread is None:
                self._thread = Thread(target=self._run, name="uorb-timekeeper", daemon=True)
                self._thread.start()
            self._changed.notify()

    def remove(self, exported: Exported) -> None:
        """Care for it no more; the last one ends the thread."""
        with self._changed:
            self._exported.discard(exported)
            self._changed.notify()

    def hurry(self) -> None:
        """Look at the due times again: one has come nearer."""
        with self._changed:
            self._changed.notify()

    def forget_all(self) -> None:
        """In a forked child the descriptors and the thread are the parent's."""
        self.__init__()  # type: ignore[misc]

    def _run(self) -> None:
        with self._changed:
            while self._exported:
                self._changed.wait(max(min(exported.due_in() for exported in self._exported), 0.0005))
                for exported in list(self._exported):
                    try:
                        exported.settle()
                    except (UorbError, OSError):  # closed at this moment
                        self._exported.discard(exported)
            self._thread = None


_timekeeper = _Timekeeper()
os.register_at_fork(after_in_child=_timekeeper.forget_all)
