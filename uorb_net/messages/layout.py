"""Where each value of a message lies in its encoding: XCDR1 little endian, as ROS 2 writes it.

A primitive is aligned to its size, counted from the byte after the 4-byte encapsulation header; an
array has one alignment at its front and no length; a nested message aligns only through its own
fields; nothing is padded at the end. Every message therefore has one fixed ``struct`` format.
"""

from collections.abc import Iterator

import msgspec

from uorb_net.messages.schema import Member, Schema

HEADER = b"\x00\x01\x00\x00"
HEADER_VALUE = int.from_bytes(HEADER, "little")


class Layout(msgspec.Struct, frozen=True):
    """``struct`` formats of a message, header included.

    Encoding packs ``HEADER_VALUE`` first and takes a bool as an integer and a bool array as bytes,
    since ``?`` would take anything; decoding skips the header and reads bools with ``?``.
    """

    encoding: str
    decoding: str


def layout(schema: Schema) -> Layout:
    """Lay a message out."""
    return Layout(f"<I{_format(schema, True)}", f"<4x{_format(schema, False)}")


def values(member: Member) -> int:
    """Return how many values ``struct`` unpacks for a member."""
    if member.is_bytes or member.is_text:
        return 1
    each = 1 if member.nested is None else sum(map(values, member.nested.members))
    return each * (member.length or 1)


def _format(schema: Schema, encoding: bool) -> str:
    parts: list[str] = []
    offset = 0
    for size, count, code in _items(schema, encoding):
        padding = -offset % size
        if padding:
            parts.append(f"{padding}x")
        parts.append(code if count == 1 and code != "s" else f"{count}{code}")
        offset += padding + size * count
    return "".join(parts)


def _items(schema: Schema, encoding: bool) -> Iterator[tuple[int, int, str]]:
    """Yield size, count and format character of every member, through all nested messages."""
    for member in schema.members:
        if member.nested is not None:
            for _ in range(member.length or 1):
                yield from _items(member.nested, encoding)
        elif member.primitive is not None:
            yield member.primitive.size, member.length or 1, _code(member, encoding)


def _code(member: Member, encoding: bool) -> str:
    assert member.primitive is not None
    if member.is_bytes or member.is_text:
        return "s"
    if member.type == "bool" and encoding:
        return "B" if member.length is None else "s"
    return member.primitive.code
