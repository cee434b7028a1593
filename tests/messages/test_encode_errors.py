"""Values that do not fit: each is refused, naming message, field path, value and the allowed range."""

import struct
from fractions import Fraction
from typing import Any

import msgspec
import numpy as np
import pytest

from uorb_net import messages
from uorb_net.errors import EncodeError
from uorb_net.messages.registry import Registry

RULE = "=" * 80
TEXT = f"""int8 i8
uint8 u8
char letter
int16 i16
uint16 u16
int32 i32
uint32 u32
int64 i64
uint64 u64
float32 f32
float64 f64
bool flag
bool other
float32[4] q
int16[12] many
uint8[3] raw
char[4] name
bool[2] flags
Cell cell
Cell[2] cells
{RULE}
MSG: px4_msgs/Cell
float32 voltage
bool ok
Lower lower
Lower[2] lowers
{RULE}
MSG: px4_msgs/Lower
uint8 level
"""

REGISTRY = Registry(shipped="/nonexistent")
Sample: Any = REGISTRY.from_text("Sample", TEXT)
Cell: Any = REGISTRY.from_text("Cell", TEXT.partition("Cell\n")[2])
Lower: Any = REGISTRY.from_text("Lower", "uint8 level\n")


class Indexable:
    """An integer in all but its class."""

    def __index__(self) -> int:
        return 5


@pytest.mark.parametrize(
    ("name", "low", "high"),
    [
        ("i8", -128, 127),
        ("u8", 0, 255),
        ("letter", 0, 255),
        ("i16", -(2**15), 2**15 - 1),
        ("u16", 0, 2**16 - 1),
        ("i32", -(2**31), 2**31 - 1),
        ("u32", 0, 2**32 - 1),
        ("i64", -(2**63), 2**63 - 1),
        ("u64", 0, 2**64 - 1),
    ],
)
def test_integers_fit_up_to_their_bounds(name: str, low: int, high: int) -> None:
    """The bounds themselves pass; one more does not, and the error states them."""
    for value in (low, high):
        assert getattr(messages.decode(Sample, messages.encode(Sample(**{name: value}))), name) == value
    for value in (low - 1, high + 1):
        with pytest.raises(EncodeError) as caught:
            messages.encode(Sample(**{name: value}))
        error = caught.value
        assert (error.message, error.field, error.value) == ("Sample", name, value)
        assert error.allowed == f"an integer {low}..{high}"
        assert str(value) in str(error)


@pytest.mark.parametrize(
    ("field", "value", "given"),
    [
        ("u8", 1.0, {"u8": 1.0}),
        ("u8", "1", {"u8": "1"}),
        ("u8", None, {"u8": None}),
        ("timestamp", None, {"timestamp": None}),
        ("timestamp", 0.0, {"timestamp": 0.0}),
        ("timestamp", "", {"timestamp": ""}),
        ("timestamp", -1, {"timestamp": -1}),
        ("f32", 3.5e38, {"f32": 3.5e38}),
        ("f32", -1e300, {"f32": -1e300}),
        ("f32", "1", {"f32": "1"}),
        ("f64", 10**400, {"f64": 10**400}),
        ("f64", None, {"f64": None}),
        ("flag", 2, {"flag": 2}),
        ("flag", -1, {"flag": -1}),
        ("flag", 1.0, {"flag": 1.0}),
        ("flag", "", {"flag": ""}),
        ("flag", None, {"flag": None}),
        ("flag", [], {"flag": []}),
        ("other", 256, {"flag": True, "other": 256}),
        ("q[2]", "x", {"q": (1, 2, "x", 4)}),
        ("q[3]", 1e39, {"q": (1, 2, 3, 1e39)}),
        ("q[0]", [1, 2], {"q": np.tile([1, 2], (4, 1))}),
        ("many[11]", 40000, {"many": [*range(11), 40000]}),
        ("name", "abcde", {"name": "abcde"}),
        ("name", "é", {"name": "é"}),
        ("name", b"abc", {"name": b"abc"}),
        ("name", 3, {"name": 3}),
        ("flags[1]", 2, {"flags": (True, 2)}),
        ("flags[0]", 0.0, {"flags": (0.0, True)}),
        ("cell", None, {"cell": None}),
        ("cell", Lower(), {"cell": Lower()}),
        ("cell.voltage", "high", {"cell": Cell(voltage="high")}),
        ("cell.ok", 3, {"cell": Cell(ok=3)}),
        ("cell.lower", 1, {"cell": Cell(lower=1)}),
        ("cell.lower.level", 256, {"cell": Cell(lower=Lower(level=256))}),
        ("cells[1]", 5, {"cells": [Cell(), 5]}),
        ("cells[1].voltage", 1e39, {"cells": [Cell(), Cell(voltage=1e39)]}),
        ("cells[0].ok", 2, {"cells": [Cell(ok=2), Cell()]}),
        ("cells[1].lowers[0].level", -1, {"cells": [Cell(), Cell(lowers=[Lower(level=-1), Lower()])]}),
    ],
)
def test_the_culprit_is_named_by_its_path(field: str, value: object, given: dict[str, Any]) -> None:
    """Nothing that ``struct`` would bend into place gets through."""
    message = Sample(**given)
    for stamp in (0, 77):
        with pytest.raises(EncodeError) as caught:
            Sample.__uorb__.encode(message, stamp)
        assert (caught.value.message, caught.value.field, caught.value.value) == ("Sample", field, value)


@pytest.mark.parametrize(
    ("given", "stored"),
    [
        ({"u8": True}, {"u8": 1}),
        ({"u8": Indexable()}, {"u8": 5}),
        ({"u8": np.uint8(5)}, {"u8": 5}),
        ({"f32": 3}, {"f32": 3.0}),
        ({"f32": True}, {"f32": 1.0}),
        ({"f64": np.float32(0.5)}, {"f64": 0.5}),
        ({"f64": Fraction(1, 2)}, {"f64": 0.5}),
        ({"f32": float("-inf")}, {"f32": float("-inf")}),
        ({"flag": 1, "other": 0}, {"flag": True, "other": False}),
        ({"flag": np.bool_(True)}, {"flag": True}),
        ({"flags": np.array([True, False])}, {"flags": (True, False)}),
        ({"flags": [1, np.bool_(True)]}, {"flags": (True, True)}),
        ({"name": "abcd"}, {"name": "abcd"}),
        ({"name": "a\0b"}, {"name": "a"}),
        ({"cells": [Cell(voltage=2), Cell(ok=True)]}, {"cells": (Cell(voltage=2.0), Cell(ok=True))}),
    ],
)
def test_values_of_kindred_kinds_fit(given: dict[str, Any], stored: dict[str, Any]) -> None:
    """Numbers of other libraries, 0 and 1 for bools, and integers for floats are taken."""
    assert messages.decode(Sample, messages.encode(Sample(**given))) == Sample(**stored)


def test_a_stamp_is_set_on_the_slow_way_too() -> None:
    """A message that needs the slow encoder is stamped like any other."""
    message = Sample(flag=np.bool_(True), u8=3)
    assert Sample.__uorb__.decode(Sample.__uorb__.encode(message, 77), 0) == Sample(timestamp=77, flag=True, u8=3)
    assert messages.decode(Sample, messages.encode(message)).timestamp == 0


def test_a_nested_type_of_equal_hash_fits() -> None:
    """What a publisher's text made of a type is the same to the encoding."""
    twin: Any = Registry(shipped="/nonexistent").from_text("Cell", TEXT.partition("Cell\n")[2])
    assert twin is not Cell
    encoded = messages.encode(Sample(cell=twin(voltage=0.5)))
    assert encoded == messages.encode(Sample(cell=Cell(voltage=0.5)))


@pytest.mark.parametrize(
    ("name", "value"),
    [("q", (1, 2, 3)), ("raw", b"12"), ("raw", b"1234"), ("many", ()), ("cells", ()), ("flags", (1,))],
)
def test_a_field_changed_by_force_is_caught(name: str, value: object) -> None:
    """Even ``force_setattr`` brings no array of a wrong length through."""
    message = Sample()
    msgspec.structs.force_setattr(message, name, value)
    with pytest.raises(EncodeError, match=name):
        messages.encode(message)


def test_nan_is_a_number() -> None:
    """NaN and infinities fit both float types."""
    data = messages.encode(Sample(f32=float("nan"), q=[float("nan")] * 4))
    decoded = messages.decode(Sample, data)
    assert decoded.f32 != decoded.f32
    assert struct.pack("<f", decoded.q[3]) == struct.pack("<f", float("nan"))
