"""How two definitions differ, in one line."""

import pytest

from uorb_net.messages import MessageType, compare
from uorb_net.messages.registry import Registry

RULE = "=" * 80


def kind(text: str, name: str = "Sample") -> MessageType:
    """Return the type of a text."""
    return Registry(shipped="/nonexistent").from_text(name, text).__uorb__


@pytest.mark.parametrize(
    ("here", "there", "expected"),
    [
        ("float32 yaw_body\nuint8 x\n", "uint8 x\n", "field yaw_body: float32 here, absent there"),
        ("uint8 x\n", "float32 yaw_body\nuint8 x\n", "field yaw_body: absent here, float32 there"),
        ("float32[4] q\n", "float64[4] q\n", "field q: float32[4] here, float64[4] there"),
        ("float32[4] q\n", "float32 q\n", "field q: float32[4] here, float32 there"),
        ("float32[4] q\n", "float32[3] q\n", "field q: float32[4] here, float32[3] there"),
        (
            "uint8 a\nuint8 b\nuint8 c\n",
            "uint8 b\nuint8 a\nuint8 c\n",
            "field a: here where b stands there (another order)",
        ),
        ("uint8 a\n", "uint8 b\n", "field a: uint8 here, absent there; field b: absent here, uint8 there"),
        (
            "int8 a\nint8 b\nint8 c\nint8 d\n",
            "bool a\nbool b\nbool c\n",
            "field a: int8 here, bool there; field b: int8 here, bool there; field c: int8 here, bool there; ...",
        ),
        (
            f"Cell[2] cells\n{RULE}\nMSG: px4_msgs/Cell\nfloat32 voltage\n",
            f"Cell[2] cells\n{RULE}\nMSG: px4_msgs/Cell\nfloat64 voltage\n",
            "field cells.voltage: float32 here, float64 there",
        ),
        (
            f"Cell cell\n{RULE}\nMSG: px4_msgs/Cell\nfloat32 voltage\n",
            "float32 cell\n",
            "field cell: Cell here, float32 there",
        ),
    ],
)
def test_the_first_difference_is_named_with_both_types(here: str, there: str, expected: str) -> None:
    """Each kind of difference reads as one line."""
    assert compare(kind(here), kind(there)) == expected


@pytest.mark.parametrize(
    "there",
    [
        "float32 x # comment\n",
        "uint64 timestamp\nfloat32 x\n",
        "uint8 LIMIT = 3\nfloat32 x\n",
        "# TOPICS a b\nfloat32 x\nuint8 ORB_QUEUE_LENGTH = 3\n",
    ],
)
def test_comments_constants_and_topics_are_no_difference(there: str) -> None:
    """Equal hashes, no difference."""
    assert compare(kind("float32 x\n"), kind(there)) is None


def test_char_is_uint8() -> None:
    """ROS 2 makes one type of them."""
    assert compare(kind("char[4] x\n"), kind("uint8[4] x\n")) is None


def test_names_alone_make_a_difference() -> None:
    """Two names of one layout are two types."""
    assert compare(kind("uint8 x\n", "One"), kind("uint8 x\n", "Two")) == "name: One here, Two there"
