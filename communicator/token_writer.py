"""Keeps this link's tokens as they are wanted: a slot holds one token, or for a moment two.

A changed slot declares its new token before it drops the old one, so that an observer sees no moment
without. Any thread may set a slot; one at a time talks to Zenoh, and holds no lock while it does.
"""

import logging
from collections.abc import Callable, Hashable
from threading import Lock
from typing import Protocol

log = logging.getLogger(__name__)


class Declared(Protocol):
    """A token that is out: Zenoh's LivelinessToken."""

    def undeclare(self) -> object:
        """Take it back."""


class TokenWriter:
    """Declares tokens through `declare` once that is attached; until then it only remembers."""

    def __init__(self, failed: Callable[[Exception], None]) -> None:
        self._failed = failed
        self._lock = Lock()
        self._declare: Callable[[str], Declared] | None = None
        self._wanted: dict[Hashable, str] = {}
        self._actual: dict[Hashable, tuple[str, Declared]] = {}
        self._changed: dict[Hashable, None] = {}
        self._working = False

    def attach(self, declare: Callable[[str], Declared]) -> None:
        """Begin to declare, slots in the order they were first set."""
        with self._lock:
            self._declare = declare
        self._work()

    def set(self, slot: Hashable, key: str | None) -> None:
        """Want the token `key` in `slot`, or none."""
        with self._lock:
            if key is None:
                self._wanted.pop(slot, None)
            else:
                self._wanted[slot] = key
            self._changed[slot] = None
        self._work()

    def clear(self, chosen: Callable[[Hashable], bool]) -> None:
        """Want no token in any slot that `chosen` picks."""
        with self._lock:
            for slot in [s for s in self._wanted if chosen(s)]:
                del self._wanted[slot]
                self._changed[slot] = None
        self._work()

    def _work(self) -> None:
        with self._lock:
            if self._working or self._declare is None:
                return
            self._working = True
        while (slot := self._next()) is not None:
            try:
                self._settle(slot)
            except Exception as error:  # a closed session, or a key Zenoh refuses
                self._failed(error)
            except BaseException:
                with self._lock:
                    self._working = False
                raise

    def _next(self) -> Hashable | None:
        with self._lock:
            for slot in self._changed:
                del self._changed[slot]
                return slot
            self._working = False
            return None

    def _settle(self, slot: Hashable) -> None:
        with self._lock:
            wanted, declare = self._wanted.get(slot), self._declare
        actual = self._actual.get(slot)
        if declare is None or wanted == (actual[0] if actual else None):
            return
        if wanted is None:
            del self._actual[slot]
        else:
            self._actual[slot] = (wanted, declare(wanted))
        if actual is not None:
            actual[1].undeclare()
