"""Message types: from ``.msg`` definitions to classes, to bytes and back.

What is here works by name on one search path for the whole process; ``uorb_net.msg`` gives the
classes as imports, and ``SomeMessage.__uorb__`` everything the bus and the link need of a type.
"""

from typing import Any, TypeVar, cast

from uorb_net.errors import DecodeError
from uorb_net.messages.compare import difference
from uorb_net.messages.layout import HEADER
from uorb_net.messages.registry import Registry
from uorb_net.messages.types import Message, MessageType

__all__ = [
    "Message",
    "MessageType",
    "add_path",
    "compare",
    "decode",
    "definition",
    "encode",
    "from_text",
    "load",
    "names",
    "topics",
    "type_for_topic",
    "type_hash",
]

M = TypeVar("M", bound=Message)

_registry = Registry()
add_path = _registry.add_path
load = _registry.load
names = _registry.names
topics = _registry.topics
definition = _registry.definition
type_hash = _registry.type_hash
type_for_topic = _registry.type_for_topic
from_text = _registry.from_text


def encode(message: Message) -> bytes:
    """Encode a message: XCDR1 little endian with the 4-byte header, as ROS 2 writes it.

    A ``timestamp`` of 0 stays 0 here; ``publish`` is what stamps.

    Raises:
        EncodeError: a value does not fit its field.
    """
    return message.__uorb__.encode(message, 0)


def decode(type: type[M], data: Any) -> M:
    """Decode a message.

    Args:
        type: the message's class.
        data: any contiguous buffer. It may be longer than the message: PX4's zenoh module sends up to 31
            bytes of tail that mean nothing, and they are ignored.

    Raises:
        DecodeError: the header is not ``00 01 xx xx``, or the data is too short.
    """
    kind = type.__uorb__
    view = memoryview(data).cast("B")
    if len(view) < kind.payload_length:
        raise DecodeError(f"{kind.name}: {len(view)} bytes, at least {kind.payload_length} are needed")
    if bytes(view[:2]) != HEADER[:2]:
        raise DecodeError(f"{kind.name}: header {view[:4].hex()}, expected 0001xxxx (CDR little endian)")
    return cast(M, kind.decode(view, 0))


def compare(here: MessageType, there: MessageType) -> str | None:
    """Say in one line how two types of one name differ: the first fields, with both types.

    Returns:
        Such as ``field q: float32[4] here, float64[4] there``; None where the hashes are equal.
    """
    if here.type_hash == there.type_hash:
        return None
    return difference(here.schema, there.schema) or f"name: {here.name} here, {there.name} there"


def _restore(name: str, full_definition: str, values: tuple[Any, ...]) -> Message:
    """Rebuild a pickled message."""
    cls = from_text(name, full_definition)
    return cls(**dict(zip(cls.__struct_fields__, values)))
