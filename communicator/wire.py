"""The frames that carry samples and control messages: layout, packing, strict parsing. No I/O.

docs/wire.md has the tables. A frame is taken whole or not at all: a wrong length puts every later
boundary in doubt, and one count per frame is a number an operator can reason about.
"""

from struct import Struct
from struct import error as StructError  # noqa: N812
from typing import NamedTuple

from communicator.channel import SampleHeader

WIRE_VERSION = 1
MAX_PAYLOAD = 64 << 20  # bytes of one sample's or control message's own content
MAX_RECORDS = 4096  # bounds what a frame full of empty records makes its reader allocate
BATCH_BYTES = 48 << 10  # with the key it stays under Zenoh's batch of 64 KiB: no fragments

_MAGIC = b"uOR" + bytes([WIRE_VERSION])
_FRAME = Struct("<4s8sQ")  # magic and version, source id, sent_us
_SAMPLE = Struct("<BBHIQQI")  # kind, flags, stream, length, sequence, published_us, withheld
_CONTROL = Struct("<BBHI")  # kind, zero, zero, length
FRAME_HEADER_BYTES = _FRAME.size
SAMPLE_HEADER_BYTES = _SAMPLE.size
CONTROL_HEADER_BYTES = _CONTROL.size
MAX_FRAME = FRAME_HEADER_BYTES + SAMPLE_HEADER_BYTES + MAX_PAYLOAD
_KIND_SAMPLE, _KIND_CONTROL = 1, 2
_LATCHED = 1


class WireError(ValueError):
    """Bytes or a key that are not this wire's."""


class Record(NamedTuple):
    """One record of a frame; `header` is None for a control message, `stream` then 0."""

    stream: int
    header: SampleHeader | None
    body: bytes


class Frame(NamedTuple):
    """A parsed frame; `source` is the sender's 8-byte instance id."""

    source: bytes
    sent_us: int
    records: list[Record]


def pack_frame_header(source: bytes, sent_us: int) -> bytes:
    """Return the bytes that open every frame."""
    return _FRAME.pack(_MAGIC, source, sent_us)


def pack_sample_header(stream: int, header: SampleHeader, length: int) -> bytes:
    """Return the bytes that precede a sample's payload of `length` bytes.

    Raises:
        ValueError: a number does not fit its field.
    """
    flags = _LATCHED if header.latched else 0
    try:
        return _SAMPLE.pack(_KIND_SAMPLE, flags, stream, length, header.sequence, header.published_us, header.withheld)
    except StructError as error:
        raise ValueError(f"sample header out of range: {header}") from error


def pack_control_header(length: int) -> bytes:
    """Return the bytes that precede a control message of `length` bytes."""
    return _CONTROL.pack(_KIND_CONTROL, 0, 0, length)


def parse_frame(data: bytes) -> Frame:
    """Take a frame apart, or refuse it as a whole.

    Raises:
        WireError: anything at all is not as docs/wire.md says.
    """
    if len(data) > MAX_FRAME:
        raise WireError(f"frame of {len(data)} bytes")
    if len(data) <= _FRAME.size:
        raise WireError("frame without records")
    magic, source, sent_us = _FRAME.unpack_from(data)
    if magic != _MAGIC:
        raise WireError(f"magic {magic.hex()}")
    records: list[Record] = []
    offset = _FRAME.size
    while offset < len(data):
        if len(records) == MAX_RECORDS:
            raise WireError("too many records")
        record, offset = _parse_record(data, offset, sent_us)
        records.append(record)
    return Frame(source, sent_us, records)


def _parse_record(data: bytes, offset: int, sent_us: int) -> tuple[Record, int]:
    if data[offset] == _KIND_SAMPLE:
        return _parse_sample(data, offset, sent_us)
    if data[offset] == _KIND_CONTROL:
        return _parse_control(data, offset)
    raise WireError(f"record kind {data[offset]}")


def _parse_sample(data: bytes, offset: int, sent_us: int) -> tuple[Record, int]:
    start = offset + _SAMPLE.size
    if start > len(data):
        raise WireError("sample header cut short")
    _, flags, stream, length, sequence, published_us, withheld = _SAMPLE.unpack_from(data, offset)
    end = start + length
    if end > len(data) or length > MAX_PAYLOAD:
        raise WireError("sample reaches past the frame")
    if flags > _LATCHED:
        raise WireError(f"sample flags {flags:#x}")
    age_us = sent_us - published_us if sent_us > published_us else 0
    header = SampleHeader(sequence, published_us, age_us, withheld, flags == _LATCHED)
    return Record(stream, header, data[start:end]), end


def _parse_control(data: bytes, offset: int) -> tuple[Record, int]:
    start = offset + _CONTROL.size
    if start > len(data):
        raise WireError("control header cut short")
    _, flags, reserved, length = _CONTROL.unpack_from(data, offset)
    end = start + length
    if end > len(data) or length > MAX_PAYLOAD:
        raise WireError("control message reaches past the frame")
    if flags or reserved:
        raise WireError("control record with reserved bits set")
    return Record(0, None, data[start:end]), end
