"""Encodings byte for byte: two independent CDR implementations are the judges."""

import struct
from collections.abc import Callable
from dataclasses import make_dataclass
from random import Random
from typing import Any

import numpy as np
import pycdr2
import pycdr2.types
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from uorb_net import messages
from uorb_net.messages import Message
from uorb_net.messages.primitives import PRIMITIVES
from uorb_net.messages.registry import Registry
from uorb_net.messages.schema import Member, Schema, split_full_text

RULE = "=" * 80


def definitions(random: Random) -> str:
    """Return a random self-contained definition of message ``Top``, nested up to three levels."""
    names = ["Top", "Middle", "Low", "Lowest"][: random.randint(1, 4)]
    texts = []
    for level, name in enumerate(names):
        lines = ["uint64 timestamp"] if random.random() < 0.5 else []
        lines += [field(random, f"f{i}", names[level + 1 :]) for i in range(random.randint(1, 7))]
        random.shuffle(lines)
        head = f"{RULE}\nMSG: px4_msgs/{name}\n" if level else ""
        texts.append(head + "\n".join(lines) + "\n")
    return "".join(texts)


def field(random: Random, name: str, nested: list[str]) -> str:
    """Return a random field."""
    kind = random.choice([*PRIMITIVES, *nested, *nested])
    length = random.choice(["", "", "[1]", "[2]", "[3]", "[11]" if kind in PRIMITIVES else "[5]"])
    return f"{kind}{length} {name}"


def random_message(random: Random, cls: type[Message]) -> Message:
    """Return a message with a random value in every field."""
    kind = cls.__uorb__
    return cls(**{member.name: random_value(random, member, kind.nested) for member in kind.schema.members})


def random_value(random: Random, member: Member, nested: dict[str, type[Message]]) -> Any:
    """Return a random value for a field."""
    if member.is_text:
        return "".join(chr(random.randint(1, 127)) for _ in range(random.randint(0, member.length or 0)))
    if member.is_bytes:
        return random.randbytes(member.length or 0)
    if member.length is None:
        return random_element(random, member, nested)
    return tuple(random_element(random, member, nested) for _ in range(member.length))


def random_element(random: Random, member: Member, nested: dict[str, type[Message]]) -> Any:
    """Return a random value for a field without array, or for one element."""
    if member.primitive is None:
        return random_message(random, nested[member.type])
    if not member.primitive.is_float:
        number = random.choice([member.primitive.low, member.primitive.high, random.randrange(2)])
        return bool(number) if member.type == "bool" else number
    code = member.primitive.code
    return struct.unpack(code, struct.pack(code, random.choice([0.0, -1.5, random.gauss(0, 1e6), float("inf")])))[0]


def plain(message: Message, array: Callable[[Member, list[Any]], Any], make: Callable[[Schema, Any], Any]) -> Any:
    """Return a message in another library's terms, with text as numbers."""
    values: dict[str, Any] = {}
    for member in message.__uorb__.schema.members:
        value = getattr(message, member.name)
        if member.is_text:
            value = value.encode("ascii").ljust(member.length or 0, b"\0")
        elements = list(value) if member.length is not None else [value]
        if member.nested is not None:
            elements = [plain(element, array, make) for element in elements]
        values[member.name] = elements[0] if member.length is None else array(member, elements)
    return make(message.__uorb__.schema, values)


def rosbags_store(cls: type[Message]) -> Any:
    """Return a rosbags type store with a class and those nested in it, ``char`` taken as ``uint8``."""
    store = get_typestore(Stores.EMPTY)
    types: dict[str, Any] = {}
    for name, text in split_full_text(cls.__name__, cls.__uorb__.full_definition).items():
        timestamp = "" if " timestamp" in text else "uint64 timestamp\n"
        types |= get_types_from_msg(timestamp + text.replace("char", "uint8"), f"px4_msgs/msg/{name}")
    store.register(types)
    return store


def rosbags_message(store: Any, message: Message) -> Any:
    """Return a message as rosbags has it."""

    def array(member: Member, elements: list[Any]) -> Any:
        if member.nested is not None:
            return elements
        assert member.primitive is not None
        return np.array(elements, dtype=np.dtype(member.primitive.code).newbyteorder("<"))

    return plain(message, array, lambda schema, values: store.types[f"px4_msgs/msg/{schema.name}"](**values))


def pycdr2_class(schema: Schema) -> Any:
    """Return a message class as pycdr2 has it."""
    fields = []
    for member in schema.members:
        kind = pycdr2_class(member.nested) if member.nested else pycdr2_type(member.type)
        fields.append((member.name, kind if member.length is None else pycdr2.types.array[kind, member.length]))
    return make_dataclass(schema.name, fields, bases=(pycdr2.IdlStruct,))


def pycdr2_type(name: str) -> Any:
    """Return a primitive as pycdr2 has it."""
    return bool if name == "bool" else getattr(pycdr2.types, "uint8" if name == "char" else name)


def pycdr2_message(message: Message) -> Any:
    """Return a message as pycdr2 has it."""
    return plain(message, lambda _, elements: elements, lambda schema, values: pycdr2_class(schema)(**values))


@settings(max_examples=120, deadline=None)
@given(st.randoms(use_true_random=False))
def test_any_message_of_any_definition_is_encoded_as_others_do(random: Random) -> None:
    """rosbags and pycdr2 write the same bytes, and decoding gives the same message back."""
    cls = Registry(shipped="/nonexistent").from_text("Top", definitions(random))
    message = random_message(random, cls)
    data = messages.encode(message)
    store = rosbags_store(cls)
    assert data.hex() == bytes(store.serialize_cdr(rosbags_message(store, message), "px4_msgs/msg/Top")).hex()
    assert data.hex() == pycdr2_message(message).serialize().hex()
    assert len(data) == cls.__uorb__.payload_length
    assert repr(messages.decode(cls, data)) == repr(message)
    assert messages.encode(messages.decode(cls, data)) == data


@settings(max_examples=60, deadline=None)
@given(st.randoms(use_true_random=False))
def test_hashes_of_any_definition_are_those_of_rosbags(random: Random) -> None:
    """rosbags computes the same RIHS01 hash."""
    cls = Registry(shipped="/nonexistent").from_text("Top", definitions(random))
    assert cls.__uorb__.type_hash == rosbags_store(cls).hash_rihs01("px4_msgs/msg/Top")


def test_well_known_bytes_and_hash() -> None:
    """An attitude sample, its bytes and its type's hash written out."""
    text = "uint64 timestamp_sample\nfloat32[4] q\nfloat32[4] delta_q_reset\nuint8 quat_reset_counter\n"
    cls = Registry(shipped="/nonexistent").from_text("VehicleAttitude", text)
    message = cls(timestamp=123456789, timestamp_sample=3, q=(1, 0, 0, 0.5), quat_reset_counter=3)
    expected = "0001000015cd5b070000000003000000000000000000803f00000000000000000000003f" + "00" * 16 + "03"
    assert messages.encode(message).hex() == expected
    assert cls.__uorb__.type_hash == "RIHS01_9af74ac6c01335f3a8612e3579d4eaa89a9d81550d933ed057f5d6252dc7e50c"


@pytest.mark.parametrize("stamp", [0, 7])
def test_the_stamp_fills_a_zero_timestamp_only(stamp: int) -> None:
    """``encode(m, stamp_us)`` stamps a 0 of the outer message; ``messages.encode`` does not."""
    text = f"uint64 timestamp\nInner inner\n{RULE}\nMSG: px4_msgs/Inner\nuint64 timestamp\n"
    cls = Registry(shipped="/nonexistent").from_text("Outer", text)
    encode, decode = cls.__uorb__.encode, cls.__uorb__.decode
    expected: Any = cls(timestamp=stamp or 99)
    assert decode(encode(cls(timestamp=stamp), 99), 0) == expected
    assert messages.encode(cls(timestamp=stamp)) == encode(cls(timestamp=stamp), 0)


def test_a_timestamp_of_another_type_is_not_stamped() -> None:
    """Only a plain ``uint64 timestamp`` is a time."""
    cls = Registry(shipped="/nonexistent").from_text("Odd", "uint8 timestamp\n")
    assert cls.__uorb__.encode(cls(), 10**6) == bytes.fromhex("0001000000")


def test_floats_are_rounded_to_their_type_by_the_encoding() -> None:
    """A ``float32`` that went through the encoding has 32 bits."""
    cls = Registry(shipped="/nonexistent").from_text("One", "float32 x\nfloat64 y\n")
    got: Any = messages.decode(cls, messages.encode(cls(x=0.1, y=0.1)))
    assert (got.x, got.y) == (np.float32(0.1), 0.1)


def test_a_mebibyte_array_is_one_value() -> None:
    """Large ``uint8`` arrays go through whole."""
    cls = Registry(shipped="/nonexistent").from_text("Big", "uint8[1048576] data\n")
    data = Random(3).randbytes(2**20)
    got: Any = messages.decode(cls, messages.encode(cls(data=data)))
    assert got.data == data
