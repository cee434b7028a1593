"""Where a vehicle's nodes live: the part that shared memory and one process's memory have in common.

A directory hands out process numbers, node buffers and sleepers' FIFOs, holds the lock under which
tables and files change, and keeps this process's open `Node` objects.
"""

import os
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from threading import RLock
from typing import TYPE_CHECKING

from .descriptors import more_descriptors
from .layout import MAGIC, SLEEPERS, W_G, W_HINT, W_MAGIC, W_SLEEPERS, Label, Shape, format_node, node_name
from .mapping import Mapping
from .tables import claim_sleeper, sleeper_entries
from .waking import End, forget_directory, poke

if TYPE_CHECKING:
    from .node import Node

Filler = Callable[[Mapping], None]  # writes tables and samples into a node that has no name yet

LOCK_WAIT = 5.0  # seconds; file work under the lock takes milliseconds
BUS_SIZE = 4096
B_PROCESS = 1  # word of .bus: the number last given to a process
B_END = 2  # the number last given to a sleeper's FIFO
B_HOLDER = 3  # process that holds the directory lock, for error messages
B_HOST = 3072  # byte offset: length byte and name of the host, as its link gave it
HOST_SIZE = 65


def host_name() -> str:
    """Return $UORB_HOST, else the system's host name."""
    return os.environ.get("UORB_HOST") or os.uname().nodename


class Directory(ABC):
    """The nodes of one vehicle's bus, as this process sees them."""

    path: str
    single = False  # one process alone, for ever
    me: int  # this process's number; never given to another
    bulletin: "memoryview[int]"  # words of .bus: a generation and a sleeper table like a node's

    def __init__(self) -> None:
        self.nodes: dict[tuple[str, int], Node] = {}
        self.fds: dict[int, int] = {}  # by FIFO number: a descriptor to write to, own and others'
        self._ends: dict[int, End] = {}  # this process's
        self.closed = False

    @abstractmethod
    def hold(self, wait: float = LOCK_WAIT) -> AbstractContextManager[object]:
        """Hold the directory lock; re-entrant. Raises BusError (EAGAIN) after `wait` seconds."""

    @abstractmethod
    def alive(self, process: int) -> bool:
        """Tell whether the process of that number lives."""

    @abstractmethod
    def pid(self, process: int) -> int:
        """Return the pid behind a process number, for messages only."""

    @abstractmethod
    def find(self, topic: str, instance: int, populate: bool = True) -> Mapping | None:
        """Map an existing node; None if there is none. `populate` loads its pages now."""

    @abstractmethod
    def install(self, label: Label, shape: Shape, fill: Filler | None = None) -> Mapping:
        """Build a node beside the others, let `fill` write into it, and give it its name."""

    @abstractmethod
    def names(self) -> list[tuple[str, int]]:
        """List (topic, instance) of every node, sorted."""

    @abstractmethod
    def new_end(self) -> End:
        """Make a FIFO for a sleeper."""

    def own_ends(self) -> list[int]:
        """List the numbers of this process's FIFOs."""
        return list(self._ends)

    def drop_end(self, end: End) -> None:
        """Close a FIFO of this process; its table entries are found dead by whoever needs the place."""
        if self._ends.pop(end.number, None) is not None:
            self.fds.pop(end.number, None)
            end.close()

    @abstractmethod
    def open_end(self, number: int) -> bool:
        """Put a descriptor for another process's FIFO into `fds`; False if its owner is gone."""

    @abstractmethod
    def forget_end(self, number: int) -> None:
        """Drop the descriptor kept for another process's FIFO."""

    @abstractmethod
    def lock_file(self, topic: str, instance: int, mapping: Mapping) -> int | None:
        """Open a descriptor to flock for a node's writers; None if `mapping` has been replaced."""

    @abstractmethod
    def sweep(self) -> None:
        """Remove what dead processes left behind (under the directory lock)."""

    @property
    def host(self) -> str:
        """This host's name on the bus: its link's, else $UORB_HOST, else the system's."""
        raw = self.bulletin.cast("B")[B_HOST : B_HOST + HOST_SIZE]
        return bytes(raw[1 : 1 + raw[0]]).decode("utf-8", "replace") or host_name()

    @host.setter
    def host(self, name: str) -> None:
        raw = name.encode()[: HOST_SIZE - 1]
        self.bulletin.cast("B")[B_HOST : B_HOST + 1 + len(raw)] = bytes([len(raw)]) + raw

    def poke(self, number: int) -> None:
        """Wake the sleeper with FIFO `number`."""
        if number in self.fds or self.open_end(number):
            fd = self.fds.get(number)
            if fd is not None and not poke(fd):  # None: another thread has just found it dead
                self.forget_end(number)

    def dead_end(self, number: int) -> bool:
        """Tell whether FIFO `number` has no owner any more."""
        self.forget_end(number)
        return number not in self.fds and not self.open_end(number)

    def arm(self, words: "memoryview[int]", number: int) -> bool:
        """Announce sleeper `number` in a node's table; False where the table is full of the living."""
        index = SLEEPERS
        if words[index] != number and not (index := self._entry(words, number)):
            return False
        words[index + 1] = 1
        words[W_HINT] = 1  # after `armed`: see docs/node.md, "Races"
        return True

    def disarm(self, words: "memoryview[int]", number: int) -> None:
        """Take the announcement of sleeper `number` back."""
        for index in sleeper_entries(words):
            if words[index] == number:
                words[index + 1] = 0

    def _entry(self, words: "memoryview[int]", number: int) -> int:
        """Return the index of a sleeper's entry, claimed if need be; 0 where the table is full."""
        for index in sleeper_entries(words):
            if words[index] == number:
                return index
        with self.hold():
            return claim_sleeper(words, number, self.dead_end) or 0

    def announce(self) -> None:
        """Step the bulletin (under the directory lock): something appeared, went or changed."""
        words = self.bulletin
        words[W_G] += 1
        if words[W_HINT]:
            wake(self, words)

    def close(self) -> None:
        """Give up this process's place in the directory; every node must be closed before."""
        self.closed = True
        for number in forget_directory(self):
            self._ends.pop(number, None)  # a thread still sleeps there: it closes it when it finds out
        for end in self._ends.values():
            end.close()
        self._ends.clear()
        self.fds.clear()

    def abandon(self) -> None:
        """Forget everything in a forked child: what is open there is its parent's."""
        self.closed = True


def wake(directory: Directory, words: "memoryview[int]") -> None:
    """Wake every armed sleeper of a table. No lock: see docs/node.md, "Sleeping"."""
    words[W_HINT] = 0
    fds = directory.fds
    for index in range(SLEEPERS, SLEEPERS + 2 * words[W_SLEEPERS], 2):
        if words[index + 1]:
            words[index + 1] = 0
            number = words[index]
            try:
                os.write(fds[number], b"\0")
            except BlockingIOError:
                continue  # full: its owner is awake
            except (KeyError, OSError):
                directory.poke(number)  # not known yet, or dead


class PrivateDirectory(Directory):
    """A bus in this process's own memory: the same code on bytearrays."""

    single = True

    def __init__(self) -> None:
        super().__init__()
        self.path = "(private)"
        self.me = 1
        self.bulletin = memoryview(bytearray(BUS_SIZE)).cast("Q")
        self.bulletin[W_MAGIC] = MAGIC
        self._lock = RLock()
        self._files: dict[tuple[str, int], Mapping] = {}
        self._count = 0

    @contextmanager
    def hold(self, wait: float = LOCK_WAIT) -> Iterator[None]:
        with self._lock:
            yield

    def alive(self, process: int) -> bool:
        return process == self.me

    def pid(self, process: int) -> int:
        return os.getpid()

    def find(self, topic: str, instance: int, populate: bool = True) -> Mapping | None:
        return self._files.get((topic, instance))

    def install(self, label: Label, shape: Shape, fill: Filler | None = None) -> Mapping:
        node_name(label.topic, label.instance)  # refuses what the shared bus refuses
        buffer = bytearray(shape.size)
        format_node(buffer, label, shape)
        self._count += 1
        mapping = Mapping(buffer, self._count)
        if fill is not None:
            fill(mapping)
        self._files[label.topic, label.instance] = mapping
        return mapping

    def names(self) -> list[tuple[str, int]]:
        return sorted(self._files)

    def new_end(self) -> End:
        with self._lock:
            self._count += 1
            fd, write_fd = more_descriptors(lambda: os.pipe2(os.O_NONBLOCK | os.O_CLOEXEC))
            end = self._ends[self._count] = End(self._count, fd, write_fd)
            self.fds[end.number] = write_fd
            return end

    def open_end(self, number: int) -> bool:
        return False

    def forget_end(self, number: int) -> None:
        return  # own sleepers live as long as this process; `close` drops them

    def lock_file(self, topic: str, instance: int, mapping: Mapping) -> int | None:
        raise AssertionError("a private node has one publishing process")

    def sweep(self) -> None:
        return  # nobody else can have left anything
