"""The slow side of encoding: coercing what a constructor is given, and finding the value that does not fit.

Neither runs while values are what they should be; both raise ``EncodeError`` naming message, field
path, value and the allowed range.
"""

import struct
from collections.abc import Callable, Iterator
from typing import Any, NoReturn

from msgspec.structs import force_setattr

from uorb_net.errors import EncodeError
from uorb_net.messages.layout import HEADER_VALUE
from uorb_net.messages.schema import Member, Schema


def coercer(schema: Schema) -> Callable[[Any], None]:
    """Return the function that turns a new message's sequences into the tuples and bytes it stores.

    It raises ``EncodeError`` where a value is no sequence or has the wrong length; elements of tuples are
    looked at when the message is encoded.
    """
    arrays = [member for member in schema.members if member.is_bytes or member.is_tuple]

    def coerce(message: Any) -> None:
        for member in arrays:
            value = getattr(message, member.name)
            stored = _bytes(schema, member, value) if member.is_bytes else _tuple(schema, member, value)
            if stored is not value:
                force_setattr(message, member.name, stored)

    return coerce


def diagnoser(schema: Schema, encoding: str, hashes: dict[str, str]) -> Callable[[Any, int], bytes]:
    """Return the encoder that looks at each value on its own.

    Args:
        schema: the message's.
        encoding: its ``struct`` format.
        hashes: type hashes of the nested messages by name.

    The encoder raises ``EncodeError`` for the first value that does not fit. Where all do, in a form only
    the fast code was too strict for (``numpy.bool_``, a nested type of equal hash), it returns the bytes.
    """
    pack = struct.Struct(encoding).pack

    def diagnose(message: Any, stamp_us: int) -> bytes:
        walk = _Walk(schema.name, hashes)
        packed = list(walk.message(schema, message, ""))
        if schema.stamped:
            at = [member.name for member in schema.members].index("timestamp")
            index = sum(1 for _ in walk.members(schema.members[:at], message, ""))
            packed[index] = packed[index] or stamp_us
        return pack(HEADER_VALUE, *packed)

    return diagnose


def _sequence(value: Any) -> list[Any] | tuple[Any, ...] | None:
    """Return a sequence's elements as plain Python values, None for what is no sequence."""
    if isinstance(value, (str, dict, set, frozenset)) or not hasattr(value, "__len__"):
        return None
    try:
        # numpy arrays, array.array and memoryview: tolist() gives Python numbers, tuple() numpy's.
        plain = value.tolist() if hasattr(value, "tolist") else value
        return plain if isinstance(plain, list) else tuple(plain)
    except Exception:
        return None


def _tuple(schema: Schema, member: Member, value: Any) -> tuple[Any, ...]:
    if type(value) is tuple and len(value) == member.length:
        return value
    elements = _sequence(value)
    if elements is None or len(elements) != member.length:
        raise EncodeError(schema.name, member.name, value, allowed(member))
    return tuple(elements)


def _bytes(schema: Schema, member: Member, value: Any) -> bytes:
    stored = _raw(value)
    if stored is None:
        elements = _sequence(value)
        if elements is None or len(elements) != member.length:
            raise EncodeError(schema.name, member.name, value, allowed(member))
        try:
            return bytes(elements)
        except (TypeError, ValueError):
            list(_Walk(schema.name, {}).elements(member, elements, member.name))
            raise EncodeError(schema.name, member.name, value, allowed(member)) from None
    if len(stored) != member.length:
        raise EncodeError(schema.name, member.name, value, allowed(member))
    return stored


def _raw(value: Any) -> bytes | None:
    """Return the bytes of a flat buffer of uint8, None for anything else."""
    if type(value) is bytes:
        return value
    try:
        view = memoryview(value)
    except TypeError:
        return None
    return view.tobytes() if view.format == "B" and view.ndim == 1 else None


def allowed(member: Member) -> str:
    """Return what a member takes, in words."""
    if member.nested is not None:
        unit = f"{member.nested.name} messages" if member.length else f"a {member.nested.name} message"
        return f"a sequence of {member.length} {unit}" if member.length else unit
    assert member.primitive is not None
    if member.is_text:
        return f"ASCII text of at most {member.length} characters"
    if member.length is None:
        return member.primitive.allowed
    return f"a sequence of {member.length}, each {member.primitive.allowed}"


class _Walk:
    """A walk over every value of a message, yielding what is packed."""

    def __init__(self, name: str, hashes: dict[str, str]) -> None:
        self.name = name
        self.hashes = hashes

    def refuse(self, path: str, value: object, what: str) -> NoReturn:
        """Raise for one value."""
        raise EncodeError(self.name, path, value, what)

    def message(self, schema: Schema, message: Any, prefix: str) -> Iterator[Any]:
        """Yield a message's values."""
        return self.members(schema.members, message, prefix)

    def members(self, members: tuple[Member, ...], message: Any, prefix: str) -> Iterator[Any]:
        """Yield the values of some members."""
        for member in members:
            yield from self.member(member, getattr(message, member.name), prefix + member.name)

    def member(self, member: Member, value: Any, path: str) -> Iterator[Any]:
        """Yield a member's values."""
        if member.is_text:
            yield self.text(member, value, path)
        elif member.is_bytes:
            yield self.raw(member, value, path)
        elif member.length is None:
            yield from self.element(member, value, path)
        else:
            if not isinstance(value, tuple) or len(value) != member.length:
                self.refuse(path, value, allowed(member))
            packed = self.elements(member, value, path)
            yield from [bytes(packed)] if member.type == "bool" else packed

    def elements(self, member: Member, value: Any, path: str) -> Iterator[Any]:
        """Yield the values of an array's elements."""
        for index, element in enumerate(value):
            yield from self.element(member, element, f"{path}[{index}]")

    def element(self, member: Member, value: Any, path: str) -> Iterator[Any]:
        """Yield the values of a member without array, or of one element."""
        if member.nested is not None:
            kind = getattr(type(value), "__uorb__", None)
            if kind is None or kind.type_hash != self.hashes[member.nested.name]:
                self.refuse(path, value, f"a {member.nested.name} message")
            yield from self.message(member.nested, value, f"{path}.")
        elif member.type == "bool":
            yield self.truth(value, path)
        else:
            yield self.number(member, value, path)

    def text(self, member: Member, value: Any, path: str) -> bytes:
        """Return the bytes of a char[N]."""
        assert member.length is not None
        if not isinstance(value, str) or not value.isascii() or len(value) > member.length:
            self.refuse(path, value, allowed(member))
        return value.encode("ascii")

    def raw(self, member: Member, value: Any, path: str) -> bytes:
        """Return the bytes of a uint8[N]."""
        if not isinstance(value, bytes) or len(value) != member.length:
            self.refuse(path, value, allowed(member))
        return value

    def truth(self, value: Any, path: str) -> int:
        """Return 0 or 1."""
        # numpy.bool_ is no int; its item() is a bool.
        plain = value.item() if hasattr(value, "item") else value
        if not isinstance(plain, int) or plain not in (0, 1):
            self.refuse(path, value, "True or False")
        return int(plain)

    def number(self, member: Member, value: Any, path: str) -> Any:
        """Return a number that ``struct`` takes for the member's type."""
        assert member.primitive is not None
        try:
            struct.pack(f"<{member.primitive.code}", value)
        except Exception:
            self.refuse(path, value, member.primitive.allowed)
        return value
