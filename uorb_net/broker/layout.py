"""The bytes of a node: where each word of header, tables and slots lies, and how they are read.

A *word* is 8 aligned bytes in native order, loaded and stored through one ``memoryview.cast("Q")``,
which CPython does with a single instruction. Word indices below are byte offsets divided by 8.
`docs/node.md` explains who may write which word, under what.
"""

from errno import EINVAL
from os import uname
from struct import Struct
from typing import Any, Final

import msgspec

from ..errors import BusError

MAGIC: Final = 0x754F5242_00000001  # "uORB" and the layout version
PAGE: Final = 4096
TOPIC_SIZE: Final = 128  # bytes of a topic's name

# -- header words ---------------------------------------------------------------------------------
W_MAGIC: Final = 0
W_QUEUE: Final = 1  # queue length n: what readers see
W_SLOTS: Final = 2  # S >= n + 2
W_STRIDE: Final = 3
W_LENGTH: Final = 4  # payload bytes
W_BASE: Final = 5  # offset of slot 0
W_MODE: Final = 6  # MODE_*
W_G: Final = 8  # generation and the two flags below
W_HINT: Final = 16  # some sleeper may be armed
W_SHARED: Final = 24  # more than one process publishes
W_BUSY: Final = 25  # number of the process inside a solo write
W_REMOTE: Final = 26  # writes that came from other hosts: G minus this numbers the local ones
W_FLOOR: Final = 32  # F: the generation at which the present advertisement began
W_PRIORITY: Final = 33
W_LOST: Final = 34  # lost by subscriptions that are gone
W_ORIGINS: Final = 35  # how many hosts the origin table holds
W_SLEEPERS: Final = 36  # entries of the sleeper table ever used: publishers scan no further
W_LAPSED: Final = 37  # generation at which a mirror's demand ended: nothing before it is an update
W_NETLOST: Final = 38  # what the link has counted as lost on the way to this node

# -- tables ---------------------------------------------------------------------------------------
PUBLISHERS: Final = 64  # word index; 32 entries of 2 words: process number; packed share
PUBLISHERS_MAX: Final = 32
SLEEPERS: Final = 128  # 64 entries of 2 words: FIFO number; armed
SLEEPERS_MAX: Final = 64
SUBSCRIBERS: Final = 256  # 64 entries of 4 words: process; count and queue_size; interval; lost
SUBSCRIBERS_MAX: Final = 64
ORIGINS_OFFSET: Final = PAGE  # bytes; 64 entries of 64 bytes: length byte, then the host's name
ORIGINS_MAX: Final = 64
ORIGIN_SIZE: Final = 64
LABEL_OFFSET: Final = 2 * PAGE  # bytes; 8 bytes length, then the label as JSON

MOVED: Final = 1 << 63
UNADVERTISED: Final = 1 << 62
GENERATION: Final = UNADVERTISED - 1

# -- slots ----------------------------------------------------------------------------------------
SLOT_HEAD: Final = Struct("<QQQQIHH")  # number, published_us, received_us, sequence, length, origin, flags
PAYLOAD: Final = SLOT_HEAD.size
FLAG_LATCHED: Final = 1

MODE_BRACKET: Final = 0  # x86-64: stores and loads keep their order
MODE_CRC: Final = 1  # small payloads elsewhere: a checksum over the slot
MODE_FENCE: Final = 2  # large payloads elsewhere: a lock's release and acquire order the accesses
CRC_LIMIT: Final = 256  # bytes; above it a checksum costs more than a fence


class Label(msgspec.Struct, frozen=True):
    """What a node is: written once by its creator."""

    topic: str
    instance: int
    type_name: str
    type_hash: str
    definition: str


class Shape(msgspec.Struct, frozen=True):
    """The numbers that decide a node's size; `pick` derives them."""

    queue_length: int
    slots: int
    stride: int
    length: int
    base: int
    mode: int

    @property
    def size(self) -> int:
        """Bytes of the whole node, whole pages."""
        return pages(self.base + self.slots * self.stride)


def is_topic(name: str) -> bool:
    """Tell whether a name can be a topic's: it becomes a file name, and may come from another host."""
    return name.isidentifier() and len(name.encode()) <= TOPIC_SIZE


def node_name(topic: str, instance: int) -> str:
    """Return the file name of a node.

    Raises:
        BusError: no topic can have that name.
    """
    if not is_topic(topic):
        raise BusError(EINVAL, f"topic {topic[:TOPIC_SIZE]!r}: letters, digits and _ only, at most {TOPIC_SIZE} bytes")
    return f"{topic}.{instance}" if instance else topic


def pages(count: int) -> int:
    """Return `count` rounded up to whole pages."""
    return (count + PAGE - 1) // PAGE * PAGE


def default_mode(length: int) -> int:
    """Return how readers verify a copy on this machine (docs/node.md, "Weakly ordered processors")."""
    if uname().machine == "x86_64":
        return MODE_BRACKET
    return MODE_CRC if length <= CRC_LIMIT else MODE_FENCE


def pick(label: Label, length: int, queue_length: int, retained: int = 0, mode: int | None = None) -> Shape:
    """Return the shape for a payload of `length` bytes that keeps `queue_length` samples readable.

    `retained` is what callback subscriptions want kept beyond that. Slots are rounded up to a power
    of two while that is cheap, so that a deeper wish later seldom replaces the node.
    """
    mode = default_mode(length) if mode is None else mode
    stride = (PAYLOAD + length + (4 if mode == MODE_CRC else 0) + 63) // 64 * 64
    need = max(queue_length, retained) + 2
    rounded = 1 << (need - 1).bit_length()
    slots = rounded if rounded * stride <= 1 << 20 else need
    base = pages(LABEL_OFFSET + 8 + len(msgspec.json.encode(label)))
    return Shape(queue_length, slots, stride, length, base, mode)


def read_label(buffer: Any) -> Label:
    """Decode the label of a node's buffer (or of its first pages)."""
    size = int.from_bytes(buffer[LABEL_OFFSET : LABEL_OFFSET + 8], "little")
    return msgspec.json.decode(bytes(buffer[LABEL_OFFSET + 8 : LABEL_OFFSET + 8 + size]), type=Label)


def read_origin(buffer: Any, index: int) -> str:
    """Decode entry `index` (from 1) of the origin table."""
    at = ORIGINS_OFFSET + (index - 1) * ORIGIN_SIZE
    return bytes(buffer[at + 1 : at + 1 + buffer[at]]).decode("utf-8", "replace")


def format_node(buffer: Any, label: Label, shape: Shape, flags: int = UNADVERTISED) -> None:
    """Fill the header of a fresh, zeroed buffer; the magic comes last."""
    text = msgspec.json.encode(label)
    buffer[LABEL_OFFSET : LABEL_OFFSET + 8 + len(text)] = len(text).to_bytes(8, "little") + text
    words = memoryview(buffer).cast("Q")
    words[W_QUEUE] = shape.queue_length
    words[W_SLOTS] = shape.slots
    words[W_STRIDE] = shape.stride
    words[W_LENGTH] = shape.length
    words[W_BASE] = shape.base
    words[W_MODE] = shape.mode
    words[W_PRIORITY] = 75
    words[W_G] = flags
    words[W_MAGIC] = MAGIC
