"""Message classes: built from a schema, immutable, each with a descriptor of its wire form.

``Message`` is the common base; ``MessageType`` is what the bus, the link and the logs work with.
"""

import struct
from collections.abc import Callable, Mapping
from typing import Any, ClassVar, cast

import msgspec

from uorb_net.messages.codec import post_init_source, source
from uorb_net.messages.fitting import coercer, diagnoser
from uorb_net.messages.layout import layout
from uorb_net.messages.primitives import PRIMITIVES
from uorb_net.messages.schema import Member, Schema
from uorb_net.messages.typehash import ros_name, type_hash

MODULE = "uorb_net.msg"


class MessageType(msgspec.Struct, frozen=True, kw_only=True, eq=False):
    """All there is to know of a message type; ``SomeMessage.__uorb__``. Compared by identity.

    Attributes:
        name: CamelCase name.
        topics: topic names, the first is the one a class stands for.
        queue_length: ``ORB_QUEUE_LENGTH`` of the definition, None where it has none.
        type_hash: ``RIHS01_`` and 64 hex digits.
        payload_length: bytes of the encoding, the 4-byte header included; always the same.
        definition: the definition's text, of this message alone.
        full_definition: self-contained text, nested definitions appended (the ``ros2msg`` form).
        schema: fields and constants with nested messages resolved.
        cls: the message class.
        nested: classes of the messages nested in the fields, by name.
        source: Python source of ``encode`` and ``decode``, for reading.
        encode: ``encode(message, stamp_us) -> bytes``; a ``timestamp`` of 0 is encoded as ``stamp_us``
            (microseconds). Raises ``EncodeError``.
        decode: ``decode(buffer, offset) -> message``; reads ``payload_length`` bytes at ``offset`` of any
            contiguous buffer without copying it, and takes any bytes: torn ones give odd values, no error.
            The header is not looked at.
    """

    name: str
    topics: tuple[str, ...]
    queue_length: int | None
    type_hash: str
    payload_length: int
    definition: str
    full_definition: str
    schema: Schema
    cls: "type[Message]"
    nested: "dict[str, type[Message]]"
    source: str
    encode: Callable[[Any, int], bytes]
    decode: Callable[[Any, int], Any]

    def __repr__(self) -> str:
        return f"<MessageType {self.name} {self.type_hash[:15]}>"


# gc=False: a message holds numbers, text and other messages, never a cycle. Not kw_only: decoding passes
# values by position, since msgspec searches keywords one by one (18 fields: 0.6 us of 1.7).
class Message(msgspec.Struct, frozen=True, gc=False):
    """Base of every message class: an immutable value with ``==``, ``hash`` and ``repr``.

    Give fields by keyword; their positions change with the definition. They are attributes by the
    definition's names; one that is a Python keyword is reached by ``getattr(m, "from")`` and given as
    ``Type(**{"from": 1})``.
    """

    __uorb__: ClassVar[MessageType]

    def __copy__(self) -> "Message":
        return self

    def __deepcopy__(self, memo: object) -> "Message":
        return self

    def __reduce__(self) -> tuple[Any, ...]:
        # The text goes along, so that another process needs no definition installed.
        from uorb_net.messages import _restore

        kind = self.__uorb__
        return _restore, (kind.name, kind.full_definition, msgspec.structs.astuple(self))


def build(schema: Schema, nested: Mapping[str, type[Message]]) -> type[Message]:
    """Build the class of a message.

    Args:
        schema: its definition, resolved.
        nested: the classes of the messages nested in its fields, by name.
    """
    cls = cast(type[Message], _struct(schema, nested))
    cls.__uorb__ = _descriptor(schema, cls, dict(nested))
    return cls


def _struct(schema: Schema, nested: Mapping[str, type[Message]]) -> type[msgspec.Struct]:
    namespace: dict[str, Any] = {constant.name: constant.value for constant in schema.definition.constants}
    namespace["__doc__"] = f"{ros_name(schema)}, topics {', '.join(schema.definition.topics)}."
    code = post_init_source(schema)
    if code:
        _execute(code, schema, scope := {"coerce": coercer(schema)})
        namespace["__post_init__"] = scope["__post_init__"]
    return msgspec.defstruct(
        schema.name,
        [(member.name, *_stored(member, nested)) for member in schema.members],
        bases=(Message,),
        namespace=namespace,
        module=MODULE,
        frozen=True,
        gc=False,
    )


def _stored(member: Member, nested: Mapping[str, type[Message]]) -> tuple[Any, Any]:
    """Return a field's Python type and its zero."""
    kind, zero = _element(member, nested)
    if member.length is None:
        return kind, zero
    if member.is_bytes:
        return bytes, bytes(member.length)
    if member.is_text:
        return str, ""
    return cast(Any, tuple)[kind, ...], (zero,) * member.length


def _element(member: Member, nested: Mapping[str, type[Message]]) -> tuple[Any, Any]:
    if member.nested is not None:
        cls = nested[member.nested.name]
        return cls, cls()
    primitive = PRIMITIVES[member.type]
    if primitive.is_float:
        return float, 0.0
    return (bool, False) if primitive.name == "bool" else (int, 0)


def _descriptor(schema: Schema, cls: type[Message], nested: dict[str, type[Message]]) -> MessageType:
    formats = layout(schema)
    code = source(schema, formats)
    below = _all_nested(nested)
    hashes = {name: kind.__uorb__.type_hash for name, kind in below.items()}
    scope: dict[str, Any] = {schema.name: cls, **below, "struct": struct, "refusals": Exception}
    scope["diagnose"] = diagnoser(schema, formats.encoding, hashes)
    _execute(code, schema, scope)
    definition = schema.definition
    return MessageType(
        name=schema.name,
        topics=definition.topics,
        queue_length=definition.queue_length,
        type_hash=type_hash(schema),
        payload_length=struct.calcsize(formats.encoding),
        definition=definition.text,
        full_definition=schema.full_text(),
        schema=schema,
        cls=cls,
        nested=nested,
        source=code,
        encode=scope["encode"],
        decode=scope["decode"],
    )


def _all_nested(nested: Mapping[str, type[Message]]) -> dict[str, type[Message]]:
    """Return nested classes of all levels by name."""
    found: dict[str, type[Message]] = {}
    for name, cls in nested.items():
        found |= {name: cls, **_all_nested(cls.__uorb__.nested)}
    return found


def _execute(code: str, schema: Schema, scope: dict[str, Any]) -> None:
    exec(compile(code, f"<{schema.name} codec>", "exec"), scope)
