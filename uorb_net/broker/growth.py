"""Replacing a node's buffer while others have it mapped: the one delicate manoeuvre, in one place.

Under the directory lock, with every writer stopped: build the new buffer, mark the old one MOVED,
rename, wake every sleeper. Marking before renaming is what makes a kill in between repairable: the
file that has the name then says MOVED itself, and whoever holds the lock next clears that.
"""

from .directory import Directory
from .layout import (
    GENERATION,
    LABEL_OFFSET,
    MODE_CRC,
    MOVED,
    PAYLOAD,
    PUBLISHERS,
    UNADVERTISED,
    W_FLOOR,
    W_G,
    W_NETLOST,
    W_REMOTE,
    W_SHARED,
    Label,
    Shape,
    pick,
)
from .mapping import Mapping
from .node import Node
from .tables import sleeper_entries


class _Copy:
    """Fills a new buffer with the tables and the newest samples of an old one, then marks the old."""

    def __init__(self, old: Mapping) -> None:
        self.old = old

    def __call__(self, mapping: Mapping) -> None:
        old, words = self.old, mapping.words
        state = old.words[W_G] & ~MOVED
        words[W_REMOTE] = old.words[W_REMOTE]
        for index in range(W_FLOOR, W_NETLOST + 1):
            words[index] = old.words[index]
        tables = slice(8 * PUBLISHERS, LABEL_OFFSET)
        mapping.buffer[tables] = old.buffer[tables]
        self._copy_samples(mapping, state & GENERATION)
        words[W_SHARED] = 1  # nobody is solo on a buffer that was not theirs
        words[W_G] = state
        old.words[W_G] |= MOVED

    def _copy_samples(self, mapping: Mapping, generation: int) -> None:
        old = self.old
        size = PAYLOAD + old.length + (4 if old.mode == MODE_CRC else 0)
        for number in range(max(0, generation - min(old.slots, mapping.slots) + 1), generation):
            source, target = old.offset(number), mapping.offset(number)
            mapping.buffer[target : target + size] = old.buffer[source : source + size]


def replace(node: Node, queue_length: int, retained: int = 0) -> None:
    """Give `node` room for `queue_length` readable samples, and `retained` for callbacks.

    Called under the directory lock. Positions are generations and stay valid; the readable samples
    move along. Readers and sleepers find the new buffer by the mark in the old.

    Raises:
        BusyError: a publisher is stopped in the middle of its write; the node stays as it was.
        BusError: no room for the new buffer; the node stays as it was.
    """
    old = node.mapping
    shape = pick(node.label, old.length, queue_length, retained, old.mode)
    with node.still():
        mapping = node.directory.install(node.label, shape, _Copy(old))
        poke_sleepers(node.directory, old)
    node.adopt(mapping)
    node.write_deferred()


def supersede(directory: Directory, old: Mapping, label: Label, shape: Shape) -> Mapping:
    """Put a fresh node of another definition in the place of one that nobody here uses."""

    def mark(_: Mapping) -> None:
        old.words[W_G] |= MOVED | UNADVERTISED

    mapping = directory.install(label, shape, mark)
    poke_sleepers(directory, old)
    return mapping


def poke_sleepers(directory: Directory, mapping: Mapping) -> None:
    """Wake every sleeper of a buffer, armed or not."""
    for index in sleeper_entries(mapping.words):
        if mapping.words[index]:
            directory.poke(mapping.words[index])
