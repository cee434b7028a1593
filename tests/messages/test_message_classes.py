"""Message classes as values: constructing, coercing, comparing, copying."""

import array
import copy
import pickle
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from uorb_net import messages
from uorb_net.errors import EncodeError
from uorb_net.messages import Message
from uorb_net.messages.registry import Registry

RULE = "=" * 80
TEXT = f"""uint8 LIMIT = 9
float32 RATIO = 0.5
bool ON = true
int32 number
bool flag
char letter
float32[3] vector
uint8[4] raw
char[5] name
bool[2] flags
Cell cell
Cell[2] cells
{RULE}
MSG: px4_msgs/Cell
float32 voltage
"""


def sample() -> Any:
    """Return the class most tests use."""
    return Registry(shipped="/nonexistent").from_text("Sample", TEXT)


def test_omitted_fields_are_zero() -> None:
    """Every field has the zero of its Python type."""
    cls = sample()
    cell = cls.__uorb__.nested["Cell"]()
    message = cls()
    assert (message.timestamp, message.number, message.letter) == (0, 0, 0)
    assert message.flag is False
    assert message.vector == (0.0, 0.0, 0.0)
    assert message.raw == bytes(4)
    assert message.name == ""
    assert message.flags == (False, False)
    assert message.cell == cell
    assert message.cells == (cell, cell)


def test_constants_are_class_attributes() -> None:
    """Constants are read from the class, floats as floats."""
    cls = sample()
    assert (cls.LIMIT, cls.RATIO, cls.ON) == (9, 0.5, True)
    assert "LIMIT" not in cls.__struct_fields__


def test_messages_are_immutable_values() -> None:
    """Frozen, equal by value, hashable, with a readable ``repr``."""
    cls = sample()
    message = cls(number=3)
    assert issubclass(cls, Message)
    assert issubclass(cls, msgspec.Struct)
    assert message == cls(number=3) != cls(number=4)
    assert hash(message) == hash(cls(number=3))
    assert "number=3" in repr(message)
    with pytest.raises(AttributeError):
        message.number = 4


def test_replace_gives_a_changed_copy_and_coerces() -> None:
    """``msgspec.structs.replace`` checks and coerces like the constructor."""
    message = sample()(number=3)
    changed = msgspec.structs.replace(message, vector=[1, 2, 3])
    assert (changed.number, changed.vector) == (3, (1, 2, 3))
    with pytest.raises(EncodeError, match="vector"):
        msgspec.structs.replace(message, vector=[1, 2])


@pytest.mark.parametrize(
    "given",
    [
        [1, 2, 3],
        range(1, 4),
        array.array("f", [1, 2, 3]),
        np.array([1, 2, 3], np.float32),
        np.array([1, 2, 3]),
        memoryview(array.array("d", [1, 2, 3])),
        b"\1\2\3",
    ],
)
def test_any_sequence_of_the_right_length_becomes_a_tuple(given: Any) -> None:
    """What is stored is a tuple of plain Python numbers."""
    stored = sample()(vector=given).vector
    assert stored == (1, 2, 3)
    assert type(stored) is tuple
    assert {type(element) for element in stored} <= {int, float}


@pytest.mark.parametrize(
    "given",
    [
        bytearray(b"\1\2\3\4"),
        memoryview(b"\1\2\3\4"),
        [1, 2, 3, 4],
        (1, 2, 3, 4),
        np.array([1, 2, 3, 4], np.uint8),
        np.array([1, 2, 3, 4], np.int64),
        array.array("H", [1, 2, 3, 4]),
    ],
)
def test_any_sequence_of_the_right_length_becomes_bytes(given: Any) -> None:
    """``uint8[N]`` is stored as ``bytes``, by value and not by memory."""
    stored = sample()(raw=given).raw
    assert stored == b"\1\2\3\4"
    assert type(stored) is bytes


@pytest.mark.parametrize(
    ("name", "given"),
    [
        ("vector", (1, 2)),
        ("vector", [1, 2, 3, 4]),
        ("vector", np.zeros(4)),
        ("vector", 5),
        ("vector", None),
        ("vector", "abc"),
        ("vector", {1, 2, 3}),
        ("vector", {1: 1, 2: 2, 3: 3}),
        ("vector", np.float32(1)),
        ("raw", b"\1\2\3"),
        ("raw", bytearray(5)),
        ("raw", 4),
        ("raw", "abcd"),
        ("raw", [1, 2, 3]),
        ("raw", np.zeros((2, 2), np.uint8)),
        ("raw", [1.5, 2, 3, 4]),
        ("flags", [True]),
        ("cells", []),
        ("cells", None),
    ],
)
def test_a_wrong_length_or_kind_is_refused_at_construction(name: str, given: Any) -> None:
    """``EncodeError`` names message and field as soon as the message is made."""
    with pytest.raises(EncodeError) as caught:
        sample()(**{name: given})
    assert caught.value.message == "Sample"
    assert caught.value.field.partition("[")[0] == name


def test_a_byte_out_of_range_is_refused_with_its_place() -> None:
    """The element that does not fit is named."""
    with pytest.raises(EncodeError, match=r"Sample\.raw\[2\] = 256 .*0\.\.255"):
        sample()(raw=[1, 2, 256, 4])


def test_pickle_and_copy() -> None:
    """Copies are the message itself; a pickle needs no installed definition."""
    cls: Any = messages.from_text("PickledSample", TEXT)
    message = cls(number=3, vector=[1, 2, 3], cells=[cls.__uorb__.nested["Cell"](voltage=0.1)] * 2)
    assert copy.copy(message) is message
    assert copy.deepcopy([message])[0] is message
    restored = pickle.loads(pickle.dumps(message))
    assert restored == message
    assert type(restored) is cls


def test_keyword_and_odd_field_names_work() -> None:
    """A Python keyword is a field reached by ``getattr``; other odd names are ordinary."""
    cls: Any = Registry(shipped="/nonexistent").from_text("Odd", "uint8 from\nuint8[2] class\nbool None\nuint8 self\n")
    message = cls(**{"from": 7, "class": [1, 2], "None": True, "self": 4})
    assert getattr(message, "from") == 7
    assert messages.decode(cls, messages.encode(message)) == message
    with pytest.raises(EncodeError, match=r"Odd\.from = 256"):
        messages.encode(cls(**{"from": 256}))


@pytest.mark.parametrize("name", ["Exception", "ValueError", "Struct", "Message"])
def test_a_message_may_have_the_name_of_something_in_python(name: str) -> None:
    """The generated code does not mistake a message for a name of its own."""
    cls = Registry(shipped="/nonexistent").from_text(name, "float32[2] x\nbool b\n")
    assert messages.decode(cls, messages.encode(cls(x=[1, 2], b=True))) == cls(x=(1, 2), b=True)
    with pytest.raises(EncodeError):
        messages.encode(cls(b=3))


def test_the_descriptor_tells_all(tmp_path: Path) -> None:
    """``__uorb__`` has names, sizes and texts, and the source that runs."""
    (tmp_path / "Sample.msg").write_text("# TOPICS first second\nuint8 ORB_QUEUE_LENGTH = 4\nCell cell\n")
    (tmp_path / "Cell.msg").write_text("float32 voltage")
    kind = Registry(str(tmp_path)).load("Sample").__uorb__
    assert (kind.name, kind.topics, kind.queue_length) == ("Sample", ("first", "second"), 4)
    assert kind.payload_length == 4 + 8 + 8 + 4
    assert kind.definition == "# TOPICS first second\nuint8 ORB_QUEUE_LENGTH = 4\nCell cell\n"
    assert kind.full_definition == f"{kind.definition}{RULE}\nMSG: px4_msgs/Cell\nfloat32 voltage\n"
    assert kind.cls.__uorb__ is kind
    assert "def encode(m, stamp_us)" in kind.source
    assert "def decode(buffer, offset)" in kind.source
