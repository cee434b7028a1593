"""One topic instance as this process has it: writing into its ring, arming sleepers, following moves.

The protocol, its races and what was measured are in docs/node.md. In short: write number k goes to
slot k mod S, of which there are at least two more than readers see; the generation word G moves last;
a reader looks at G again after reading (`slots`). While one process alone publishes it writes without
a system call (*solo*); a second one ends that by a handshake, and from then on flock excludes.
"""

import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager
from threading import RLock
from time import monotonic, sleep
from typing import TYPE_CHECKING, Any

from ..errors import BusyError, ClosedError
from .directory import Directory, wake
from .layout import GENERATION, MOVED, UNADVERTISED, W_BUSY, W_G, W_HINT, W_NETLOST, W_REMOTE, W_SHARED, Label
from .mapping import Mapping
from .tables import release_sleeper, shares, sleeper_entries

if TYPE_CHECKING:
    from ..messages import Message, MessageType
    from ..subscription import Subscription

WRITE_WAIT = 0.1  # seconds a publish waits for a co-publisher that was stopped
JOIN_PAUSE = 0.001  # seconds; a thousand times longer than a store lingers in a store buffer

Fields = tuple[bytes, int, int, int, int, int]  # payload, published, received, sequence, origin, flags


class Node:
    """A mapped node, shared by all publications and subscriptions of this process on it."""

    __slots__ = (
        "_deferred", "_joining", "_lock", "_lock_fd", "_me", "_solo", "_writing", "cache", "checked",
        "directory", "label", "mapping", "name", "publishing", "subscriber", "subscriptions", "type", "users",
    )  # fmt: skip

    def __init__(self, directory: Directory, label: Label, type_: "MessageType", mapping: Mapping) -> None:
        self.directory = directory
        self.label = label
        self.type = type_
        self.name = f"{label.topic} instance {label.instance}" if label.instance else label.topic
        self.mapping = mapping
        self.users = 0  # publications, subscriptions and link entries that hold this object
        self.publishing = 0  # publications of this process, the link's mirrors included
        self.subscriptions: set[Subscription[Any]] = set()
        self.subscriber = 0  # word index of this process's subscriber entry; 0: none
        self.cache: tuple[int, Message | None] = (0, None)  # the newest decoded: its number, the object
        self.checked = 0.0  # when a reader last asked whether a publisher lives
        self._me = directory.me
        self._lock = RLock()  # re-entrant, so that a publish in a signal handler can tell
        self._writing = False
        self._deferred: list[Fields] = []
        self._solo = False
        self._joining = False
        self._lock_fd = -1

    # -- writing -----------------------------------------------------------------------------------

    def write(
        self,
        payload: bytes,
        published_us: int,
        received_us: int,
        sequence: int = 0,
        origin: int = 0,
        flags: int = 0,
    ) -> None:
        """Append one sample and wake who sleeps on the node.

        Times are microseconds of this host's clock; `sequence` 0 numbers a local publication.

        Raises:
            ClosedError: this process does not publish here any more.
            BusyError: another process stopped in the middle of its write; nothing was written.
        """
        done = False
        with self._lock:
            if self._writing:  # a signal handler interrupted this very method: its sample comes after
                self._deferred.append((payload, published_us, received_us, sequence, origin, flags))
                return
            self._writing = True
            try:
                if self._solo:
                    mapping = self.mapping
                    words = mapping.words
                    words[W_BUSY] = self._me
                    word = words[W_G]
                    if not (words[W_SHARED] or word >> 62):
                        mapping.pack(
                            mapping.buffer,
                            mapping.base + word % mapping.slots * mapping.stride,
                            word + 1,
                            published_us,
                            received_us,
                            sequence or word + 1 - words[W_REMOTE],
                            mapping.length,
                            origin,
                            flags,
                            payload,
                        )
                        words[W_G] = word + 1
                        if origin:
                            words[W_REMOTE] += 1
                        done = True
            finally:
                self._writing = False
                if self._solo:
                    self.mapping.words[W_BUSY] = 0
        if not done:
            self._write_slowly((payload, published_us, received_us, sequence, origin, flags))
        if self._deferred:
            self.write_deferred()
        words = self.mapping.words
        if words[W_HINT]:
            wake(self.directory, words)

    def _write_slowly(self, fields: Fields) -> None:
        """Write among several processes, or after the node was moved or unadvertised under us."""
        while True:
            mapping = self.mapping
            with self._lock:
                if not self.publishing:
                    raise ClosedError(f"publication on {self.name} was unadvertised")
                self._writing = True
                try:
                    with self._exclusion(mapping):
                        word = mapping.words[W_G]
                        if not word >> 62:
                            self._store(mapping, word, fields)
                            return
                finally:
                    self._writing = False
            self.recover()

    def _store(self, mapping: Mapping, word: int, fields: Fields) -> None:
        payload, published_us, received_us, sequence, origin, flags = fields
        words = mapping.words
        sequence = sequence or word + 1 - words[W_REMOTE]
        mapping.pack(
            mapping.buffer, mapping.offset(word), word + 1, published_us, received_us, sequence,
            mapping.length, origin, flags, payload,
        )  # fmt: skip
        words[W_G] = word + 1
        if origin:
            words[W_REMOTE] += 1

    def write_deferred(self) -> None:
        """Write what signal handlers published while this thread was busy with the node."""
        while True:
            try:
                fields = self._deferred.pop(0)
            except IndexError:
                return  # all written, perhaps by another thread
            self.write(*fields)

    @contextmanager
    def _exclusion(self, mapping: Mapping) -> Iterator[None]:
        """Exclude the writers of all other processes; within this process `_lock` does."""
        deadline = monotonic() + WRITE_WAIT
        if self.directory.single:
            yield
            return
        if self._lock_fd < 0:
            fd = self.directory.lock_file(self.label.topic, self.label.instance, mapping)
            if fd is None:  # replaced: its G says MOVED by now
                yield
                return
            self._lock_fd = fd
        self._flock(deadline)
        try:
            self._solo = False
            if self._joining or not mapping.words[W_SHARED]:
                self._join(mapping.words, deadline)
            yield
        finally:
            fcntl.flock(self._lock_fd, fcntl.LOCK_UN)

    def _flock(self, deadline: float) -> None:
        pause = 0.00005
        while True:
            try:
                fcntl.flock(self._lock_fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
                return
            except BlockingIOError:
                self._too_late(deadline)
            sleep(pause)
            pause = min(pause * 2, 0.001)

    def _join(self, words: "memoryview[int]", deadline: float) -> None:
        """End another process's solo spell: let its current write finish (docs/node.md, "Joining")."""
        words[W_SHARED] = 1
        sleep(JOIN_PAUSE)
        while (busy := words[W_BUSY]) and busy != self._me:
            if not self.directory.alive(busy):
                words[W_BUSY] = 0
                break
            self._too_late(deadline)
            sleep(0.0002)
        self._joining = False

    def _too_late(self, deadline: float) -> None:
        if monotonic() > deadline:
            holder = self.mapping.words[W_BUSY]
            pids = [
                self.directory.pid(share.process)
                for share in shares(self.mapping.words)
                if share.process != self._me and (not holder or share.process == holder)
            ]
            raise BusyError(
                f"{self.name}: another publisher is stopped in the middle of a publication "
                f"(process {' or '.join(map(str, pids)) or 'unknown'}); nothing was published"
            )

    # -- following the node ------------------------------------------------------------------------

    def recover(self) -> None:
        """Go on after MOVED or UNADVERTISED: map the node that has the name now, take our place in it."""
        directory = self.directory
        with directory.hold():
            self.remap()
            words = self.mapping.words
            if self.publishing and words[W_G] & UNADVERTISED:
                raise ClosedError(f"publication on {self.name} was taken back: its process was held for dead")

    def remap(self) -> None:
        """Pick up the node's present buffer (under the directory lock)."""
        current = self.directory.find(self.label.topic, self.label.instance)
        if current is None or current.label().type_hash != self.label.type_hash:
            raise ClosedError(f"{self.name} was replaced on the bus by another definition")
        if current.identity == self.mapping.identity:
            if current.words[W_G] & MOVED:
                # Whoever marked it was killed before the rename; nobody can have written to its copy.
                # Never without the mark: another thread may have followed already, and G be written to.
                current.words[W_G] &= ~MOVED
            return
        self.adopt(current)

    def adopt(self, mapping: Mapping) -> None:
        """Use `mapping` from now on; its tables are a copy of the old one's, so indices hold."""
        with self._lock:
            self.mapping = mapping
            self._drop_lock_file()
            for subscription in list(self.subscriptions):
                subscription._follow()
        self.refresh_subscriber()
        self.settle_writers()

    def settle_writers(self, newcomer: bool = False) -> None:
        """Be solo where no other live process publishes, else shared (under the directory lock)."""
        words = self.mapping.words
        with self._lock:
            if not self.publishing:
                self._solo = False
            elif all(share.process == self._me for share in shares(words)):
                words[W_SHARED] = 0
                words[W_BUSY] = 0
                self._solo = True
            elif newcomer or not words[W_SHARED]:
                words[W_SHARED] = 1
                self._solo = False
                self._joining = True

    @contextmanager
    def still(self) -> Iterator[None]:
        """Stop every writer of the node, in all processes (under the directory lock)."""
        with self._lock:
            self._joining = True
            self._writing = True  # what a signal handler publishes meanwhile comes after
            try:
                with self._exclusion(self.mapping):
                    yield
            finally:
                self._writing = False

    def leave_writers(self) -> None:
        """Write no more: the last publication of this process is going (under the directory lock)."""
        with self._lock:
            self._solo = False

    def close(self) -> None:
        """Give up the flock descriptor; the mapping goes with its last user."""
        self._drop_lock_file()

    def _drop_lock_file(self) -> None:
        if self._lock_fd >= 0:
            os.close(self._lock_fd)
            self._lock_fd = -1

    # -- subscribers and sleepers ------------------------------------------------------------------

    def refresh_subscriber(self) -> bool:
        """Write this process's subscriber entry anew; True if what the link must know has changed."""
        if not self.subscriber:
            return False
        words = self.mapping.words
        intervals = [subscription.interval_us for subscription in self.subscriptions]
        depth = max((subscription.queue_size for subscription in self.subscriptions), default=0)
        before = (words[self.subscriber + 1], words[self.subscriber + 2])
        words[self.subscriber + 1] = len(intervals) | depth << 32
        words[self.subscriber + 2] = min(intervals, default=0)
        after = (words[self.subscriber + 1], words[self.subscriber + 2])
        return (not before[0] & 0xFFFFFFFF) or before[1] != after[1]

    def count_lost(self, count: int) -> None:
        """Add to what this process's subscriptions lost; threads of the process exclude each other."""
        with self._lock:
            if self.subscriber:
                self.mapping.words[self.subscriber + 3] += count

    def count_network_lost(self, count: int) -> None:
        """Add to what the link lost on the way to this node; only the link's process writes the word."""
        with self._lock:
            self.mapping.words[W_NETLOST] += count

    def forget_sleepers(self, numbers: list[int]) -> None:
        """Free the entries of this process's FIFOs (under the directory lock)."""
        for number in numbers:
            release_sleeper(self.mapping.words, number)

    def poke_own(self) -> None:
        """Wake the sleepers of this process that know the node: something changed under them."""
        own = set(self.directory.own_ends())
        words = self.mapping.words
        for index in sleeper_entries(words):
            if words[index] in own:
                self.directory.poke(words[index])

    @property
    def generation(self) -> int:
        """Number of writes so far."""
        return self.mapping.words[W_G] & GENERATION
