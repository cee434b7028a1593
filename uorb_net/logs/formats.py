"""The formats of a ULog file: what a row's bytes mean.

A format is parsed from its ``F`` message; a layout adds sizes and the place of the timestamp. Rows
have no alignment of their own: members lie one after the other, ``_padding*`` members included.
Errors here are plain ``ValueError``; the reader turns them into faults of the file.
"""

import re
import struct
from collections.abc import Iterator, Mapping

import msgspec

#: C type of a ULog member -> its struct code; the size follows from the code.
PRIMITIVES = {
    "int8_t": "b",
    "uint8_t": "B",
    "int16_t": "h",
    "uint16_t": "H",
    "int32_t": "i",
    "uint32_t": "I",
    "int64_t": "q",
    "uint64_t": "Q",
    "float": "f",
    "double": "d",
    "bool": "?",
    "char": "c",
}
SIZES = {name: struct.calcsize("<" + code) for name, code in PRIMITIVES.items()}

#: Longest row: a message's length has 16 bits, and the row follows a two-byte msg_id.
MAX_ROW = 0xFFFF - 2

_NAME = r"[A-Za-z0-9_\-/]+"
_FORMAT = re.compile(rf"({_NAME}):(.*)", re.DOTALL)
_FIELD = re.compile(r"([A-Za-z0-9_\-/]+)(?:\[([0-9]{1,5})\])? (\S+)")
_TIMESTAMP_TYPES = ("uint64_t", "uint32_t", "uint16_t", "uint8_t")
# Deeper nesting than this is nobody's message, only an attack on the stack.
_MAX_DEPTH = 16


class Field(msgspec.Struct, frozen=True):
    """A member of a format: C type or format name, array length (0 for a scalar), name."""

    type: str
    count: int
    name: str

    @property
    def is_padding(self) -> bool:
        """Whether the member only fills space: it is part of the layout, not of the message."""
        return self.name.startswith("_padding")


class Format(msgspec.Struct, frozen=True):
    """A message format as the log declares it; ``fields`` holds the padding members too."""

    name: str
    fields: tuple[Field, ...]


class Layout(msgspec.Struct, frozen=True):
    """The outer measures of a format's rows.

    Attributes:
        size: bytes of a full row, padding at the end included.
        needed: bytes up to the end of the last member that is no padding; a shorter row is broken.
        timestamp_at: offset of the top-level timestamp, -1 where the format has none.
        timestamp_code: struct code of the timestamp.
    """

    size: int
    needed: int
    timestamp_at: int
    timestamp_code: str


class Leaf(msgspec.Struct, frozen=True):
    """A primitive member, or array of primitives, at its place in the row.

    Attributes:
        path: the name from the top, such as ``esc[2].esc_rpm``.
        type: the C type.
        count: array length, 0 for a scalar.
        at: byte offset in the row.
    """

    path: str
    type: str
    count: int
    at: int


def parse_format(text: str) -> Format:
    """Parse the text of an ``F`` message, ``name:type member;type[n] member;``.

    Raises:
        ValueError: the text is no format.
    """
    match = _FORMAT.fullmatch(text)
    if match is None:
        raise ValueError(f"not a format: {text[:40]!r}")
    return Format(match[1], tuple(_parse_field(part) for part in match[2].split(";") if part))


def _parse_field(text: str) -> Field:
    match = _FIELD.fullmatch(text)
    if match is None or (match[2] is not None and not 0 < int(match[2]) <= MAX_ROW):
        raise ValueError(f"not a member: {text[:40]!r}")
    return Field(match[1], int(match[2] or 0), match[3])


def measure(name: str, formats: Mapping[str, Format]) -> Layout:
    """Return the layout of the format called ``name``.

    Raises:
        ValueError: an unknown or recursive type, an empty format, or a row no message can hold.
    """
    size, needed = _extent(name, formats, 0)
    at = 0
    for field in formats[name].fields:
        if field.name == "timestamp" and not field.count and field.type in _TIMESTAMP_TYPES:
            return Layout(size, needed, at, "<" + PRIMITIVES[field.type])
        at += _element(field, formats, 0)[0] * (field.count or 1)
    return Layout(size, needed, -1, "")


def _extent(name: str, formats: Mapping[str, Format], depth: int) -> tuple[int, int]:
    """Return size and needed bytes of a format; every format that passes takes at least one byte."""
    if depth > _MAX_DEPTH:
        raise ValueError(f"format {name} nests too deep or contains itself")
    if name not in formats:
        raise ValueError(f"no format {name}")
    at = needed = 0
    for field in formats[name].fields:
        size, inner = _element(field, formats, depth)
        if not field.is_padding:
            needed = at + size * (max(field.count, 1) - 1) + inner
        at += size * (field.count or 1)
        # Checked member by member: it also bounds the work a hostile nest of formats can cause.
        if at > MAX_ROW:
            raise ValueError(f"a row of {name} is longer than a message can be")
    if not needed:
        raise ValueError(f"format {name} has no fields")
    return at, needed


def _element(field: Field, formats: Mapping[str, Format], depth: int) -> tuple[int, int]:
    size = SIZES.get(field.type)
    return _extent(field.type, formats, depth + 1) if size is None else (size, size)


def leaves(name: str, formats: Mapping[str, Format]) -> Iterator[Leaf]:
    """Yield the primitive members of a measured format in row order, without the padding."""
    yield from _walk(name, formats, "", 0)


def _walk(name: str, formats: Mapping[str, Format], prefix: str, at: int) -> Iterator[Leaf]:
    for field in formats[name].fields:
        size, _ = _element(field, formats, 0)
        path = prefix + field.name
        if field.type in SIZES and not field.is_padding:
            yield Leaf(path, field.type, field.count, at)
        elif not field.is_padding:
            for i in range(field.count or 1):
                inner = f"{path}[{i}]." if field.count else f"{path}."
                yield from _walk(field.type, formats, inner, at + i * size)
        at += size * (field.count or 1)
