"""A mapped node buffer with the numbers every call on it needs."""

from typing import Any

from .layout import (
    ORIGIN_SIZE,
    ORIGINS_MAX,
    ORIGINS_OFFSET,
    W_BASE,
    W_LENGTH,
    W_MODE,
    W_ORIGINS,
    W_QUEUE,
    W_SLOTS,
    W_STRIDE,
    Label,
    read_label,
    read_origin,
)
from .slots import packer


class Mapping:
    """One mapped node buffer and what a call needs of it; never changed, only replaced whole.

    A thread works on the mapping it picked up until its call ends, so the buffer is never closed
    by hand: it goes with its last user.
    """

    __slots__ = (
        "base",
        "buffer",
        "identity",
        "length",
        "mode",
        "pack",
        "queue_length",
        "slots",
        "stride",
        "words",
    )

    def __init__(self, buffer: Any, identity: int) -> None:
        self.buffer = buffer
        self.words: memoryview[int] = memoryview(buffer).cast("Q")
        words = self.words
        self.queue_length = words[W_QUEUE]
        self.slots = words[W_SLOTS]
        self.stride = words[W_STRIDE]
        self.length = words[W_LENGTH]
        self.base = words[W_BASE]
        self.mode = words[W_MODE]
        self.identity = identity  # inode: tells a replaced file from this one
        self.pack = packer(self.length, self.mode)

    def offset(self, number: int) -> int:
        """Return the byte offset of the slot that holds write `number` (from 0)."""
        return self.base + number % self.slots * self.stride

    def label(self) -> Label:
        """Return what the node is."""
        return read_label(self.buffer)

    def origin(self, index: int) -> str:
        """Return the host name behind a slot's origin; "" for this host."""
        return read_origin(self.buffer, index) if index else ""

    def origin_index(self, host: str) -> int:
        """Return the index of `host` in the origin table, adding it (under the directory lock).

        A full table gives the last index, whose name is then the newest host's.
        """
        words = self.words
        known = words[W_ORIGINS]
        for index in range(1, known + 1):
            if read_origin(self.buffer, index) == host:
                return index
        index = min(known + 1, ORIGINS_MAX)
        raw = host.encode()[: ORIGIN_SIZE - 1]
        at = ORIGINS_OFFSET + (index - 1) * ORIGIN_SIZE
        self.buffer[at : at + 1 + len(raw)] = bytes([len(raw)]) + raw
        words[W_ORIGINS] = index
        return index
