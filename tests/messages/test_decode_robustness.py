"""Decoding: what is refused, and what never raises."""

import mmap
import tempfile
from random import Random
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from uorb_net import messages
from uorb_net.errors import DecodeError
from uorb_net.messages.registry import Registry

RULE = "=" * 80
TEXT = f"""bool flag
bool[3] flags
float32 x
float64[2] y
float32[9] many
char[4] name
uint8[5] raw
char letter
Cell cell
Cell[3] cells
{RULE}
MSG: px4_msgs/Cell
float32 voltage
bool ok
Lower[2] lowers
{RULE}
MSG: px4_msgs/Lower
uint16 level
char[2] mark
"""

REGISTRY = Registry(shipped="/nonexistent")
Sample: Any = REGISTRY.from_text("Sample", TEXT)
Small: Any = REGISTRY.from_text("Small", "uint8 u\nchar[3] name\nbool ok\n")
LENGTH = Sample.__uorb__.payload_length


@settings(deadline=None)
@given(st.binary(min_size=LENGTH, max_size=LENGTH))
def test_random_bytes_never_raise(data: bytes) -> None:
    """Torn reads of the ring give odd values, never an error, and values of the right kinds."""
    message = Sample.__uorb__.decode(data, 0)
    assert type(message) is Sample
    assert {type(value) for value in (message.flag, *message.flags, message.cells[2].ok)} == {bool}
    assert [type(message.name), type(message.raw), len(message.raw)] == [str, bytes, 5]
    assert "\0" not in message.name + message.cells[1].lowers[1].mark


def test_every_nonzero_byte_is_true() -> None:
    """A bool is true for any byte but 0."""
    data = bytearray(messages.encode(Small(ok=True)))
    data[-1] = 0xFE
    assert messages.decode(Small, data).ok is True


@pytest.mark.parametrize(
    ("raw", "text"), [(b"ab\0", "ab"), (b"a\0b", "a"), (b"\xe9\xff\x80", "\xe9\xff\x80"), (b"\0xy", "")]
)
def test_text_is_latin_1_up_to_the_first_nul(raw: bytes, text: str) -> None:
    """Other bytes than ASCII read back as their Latin-1 character."""
    data = messages.encode(Small(u=1))[:13] + raw + b"\0"
    assert messages.decode(Small, data).name == text


@pytest.mark.parametrize("kind", [bytes, bytearray, memoryview])
def test_any_buffer_is_decoded_at_an_offset(kind: type) -> None:
    """The descriptor's ``decode`` reads in place."""
    message = Small(timestamp=9, u=1, name="abc", ok=True)
    assert Small.__uorb__.decode(kind(b"12345" + messages.encode(message) + b"tail"), 5) == message


def test_shared_memory_is_decoded_in_place() -> None:
    """A memory map is a buffer like any other."""
    message = Small(timestamp=9, u=1, name="abc", ok=True)
    with tempfile.TemporaryFile() as file:
        file.write(bytes(64) + messages.encode(message))
        file.flush()
        with mmap.mmap(file.fileno(), 0) as mapped:
            assert Small.__uorb__.decode(mapped, 64) == message
            assert messages.decode(Small, memoryview(mapped)[64:]) == message


@settings(deadline=None)
@given(st.binary(max_size=31))
def test_a_tail_is_ignored(tail: bytes) -> None:
    """PX4 sends up to 31 bytes more than the message has."""
    message = Small(timestamp=9, u=1)
    assert messages.decode(Small, messages.encode(message) + tail) == message


def test_other_options_in_the_header_are_accepted() -> None:
    """Only the first two bytes of the header say how to read."""
    data = messages.encode(Small(u=1))
    assert messages.decode(Small, b"\0\1\xab\xcd" + data[4:]) == Small(u=1)


@pytest.mark.parametrize("length", [0, 1, 3, 4, 16])
def test_short_data_is_refused(length: int) -> None:
    """Anything shorter than the type is ``DecodeError``."""
    data = messages.encode(Small(u=1))
    assert len(data) == 17
    with pytest.raises(DecodeError, match=f"Small: {length} bytes, at least 17"):
        messages.decode(Small, data[:length])


@pytest.mark.parametrize("header", ["00000000", "00020000", "01010000", "00030000", "ffffffff"])
def test_another_encapsulation_is_refused(header: str) -> None:
    """Big endian, parameter lists and garbage are ``DecodeError``."""
    with pytest.raises(DecodeError, match=header):
        messages.decode(Small, bytes.fromhex(header) + messages.encode(Small(u=1))[4:])


def test_a_message_with_many_nested_ones_is_decoded_in_order() -> None:
    """Elements whose alignment differs from one to the next keep their places."""
    kind: Any = REGISTRY.from_text(
        "Many", f"Odd[100] odds\n{RULE}\nMSG: px4_msgs/Odd\nuint8 timestamp\nuint16 b\nuint8 c\n"
    )
    odd = kind.__uorb__.nested["Odd"]
    random = Random(1)
    message = kind(odds=[odd(timestamp=random.randrange(256), b=i, c=random.randrange(256)) for i in range(100)])
    assert messages.decode(kind, messages.encode(message)) == message
