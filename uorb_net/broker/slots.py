"""One slot: how it is written, and read so that torn or overtaken bytes are never returned.

Three modes, chosen by a node's creator. *Bracket*: G is stored after the slot and loaded again after
reading; enough where stores and loads keep their order (x86-64). *CRC*: a checksum over the slot
proves the bytes, whatever order they became visible in. *Fence*: a lock's release and acquire order
slot and G on both sides (for payloads too long to sum). So correctness never rests on x86's order.
"""

from collections.abc import Callable
from struct import Struct
from threading import Lock
from time import monotonic, sleep
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar
from zlib import crc32

from .layout import GENERATION, MODE_BRACKET, MODE_CRC, MODE_FENCE, PAYLOAD, SLOT_HEAD, W_G

if TYPE_CHECKING:
    from .mapping import Mapping

T = TypeVar("T")
Pack = Callable[..., None]
PATIENCE = 0.1  # seconds; stores become visible to other processors within microseconds
CRC_RESIDUE = 0x2144DF1C  # crc32 of anything followed by its own crc32 (little endian)


class Sample(NamedTuple):
    """A slot: its header's fields, and the payload."""

    number: int  # the sample's generation, from 1
    published_us: int
    received_us: int
    sequence: int
    length: int
    origin: int  # 0: this host; else an index into the node's origin table
    flags: int
    payload: bytes


def fence() -> None:
    """Order every memory access before the call against every one after it.

    A store-release followed by a load-acquire of the same word, which is what a lock's release and
    acquire are, does that on ARMv8 ([range(rmw)]; rfi; [A] of its memory model).
    """
    token = Lock()
    token.acquire()
    token.release()
    token.acquire()


def packer(length: int, mode: int) -> Pack:
    """Return ``pack(buffer, offset, *fields)``; the fields are those of `Sample`, in its order."""
    pack = Struct(f"<QQQQIHH{length}s").pack_into
    if mode == MODE_BRACKET:
        return pack
    size = PAYLOAD + length

    def pack_crc(buffer: Any, offset: int, *fields: Any) -> None:
        pack(buffer, offset, *fields)
        end = offset + size
        buffer[end : end + 4] = crc32(bytes(buffer[offset:end])).to_bytes(4, "little")

    def pack_fence(buffer: Any, offset: int, *fields: Any) -> None:
        pack(buffer, offset, *fields)
        fence()

    return pack_crc if mode == MODE_CRC else pack_fence


def decoded(mapping: "Mapping", number: int, decode: Callable[[Any, int], T]) -> T | None:
    """Decode write `number` (from 0) straight from the ring; None if it was overtaken or is torn."""
    at = mapping.base + number % mapping.slots * mapping.stride
    mode = mapping.mode
    if mode == MODE_CRC:
        raw = bytes(mapping.buffer[at : at + PAYLOAD + mapping.length + 4])
        if crc32(raw) != CRC_RESIDUE:
            return None
        message = decode(raw, PAYLOAD)
    else:
        message = decode(mapping.buffer, at + PAYLOAD)
        if mode == MODE_FENCE:
            fence()
    words = mapping.words
    if (words[W_G] & GENERATION) - number < mapping.slots and words[at >> 3] == number + 1:
        return message
    return None


def read(mapping: "Mapping", number: int) -> Sample | None:
    """Return write `number` (from 0) with its header; None if it was overtaken or is torn."""
    return decoded(mapping, number, lambda buffer, at: _sample(buffer, at, mapping.length))


def damaged(mapping: "Mapping", number: int) -> bool:
    """Tell whether write `number` (from 0) stays unreadable though nobody has overtaken it."""
    words = mapping.words
    deadline = monotonic() + PATIENCE
    while (word := words[W_G]) - number < mapping.slots and not word >> 62 and read(mapping, number) is None:
        if monotonic() > deadline:
            return True
        sleep(0.001)
    return False


def _sample(buffer: Any, at: int, length: int) -> Sample:
    head = SLOT_HEAD.unpack_from(buffer, at - PAYLOAD)
    return Sample._make((*head, bytes(buffer[at : at + length])))
