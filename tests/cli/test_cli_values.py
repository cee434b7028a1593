"""Values as text and JSON: shortest floats, and JSON that reads back as the same message."""

import json
import math
import struct
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from uorb_net import messages
from uorb_net.cli.values import dumps, float_text, loads, message_from, plain, text_lines

TEXT = """uint64 timestamp
float32 single
float64 wide
float32[2] pair
uint8[2] raw
char[4] label
char letter
bool[2] flags
int64 low
Inner[2] inner
"""
FULL = f"{TEXT}{'=' * 80}\nMSG: px4_msgs/Inner\nuint64 timestamp\nfloat32 x\n"
Whole = messages.from_text("Whole", FULL)
SINGLES = st.floats(width=32)
WIDE = st.floats()


def single(value: float) -> float:
    """Return a value as a float32 holds it."""
    return float(struct.unpack("<f", struct.pack("<f", value))[0])


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0.1, "0.1"),
        (-1.0, "-1"),
        (46.0, "46"),
        (16777216.0, "16777216"),
        (1e-45, "1e-45"),
        (3.4028234663852886e38, "3.4028235e+38"),
        (math.nan, "nan"),
        (-math.inf, "-inf"),
        (-0.0, "-0"),
    ],
)
def test_a_float32_is_as_short_as_it_can_be(value: float, text: str) -> None:
    """No digits that float32 does not have, no trailing `.0`."""
    assert float_text(single(value), single=True) == text


@given(SINGLES)
def test_a_float32_reads_back(value: float) -> None:
    """The text gives the same float32, and no shorter one does."""
    text = float_text(value, single=True)
    assert single(float(text)) == value or math.isnan(value)
    digits = len(text.split("e")[0].strip("-").replace(".", "").strip("0"))
    if math.isfinite(value) and 1 < digits < 9:
        assert f"{value:.{digits - 1}g}" in ("inf",) or not _reads_back(f"{value:.{digits - 1}g}", value)


def _reads_back(text: str, value: float) -> bool:
    try:
        return single(float(text)) == value
    except OverflowError:
        return False


@given(WIDE)
def test_a_float64_reads_back(value: float) -> None:
    """As Python writes it, without `.0`."""
    text = float_text(value, single=False)
    assert float(text) == value or math.isnan(value)
    assert not text.endswith(".0")


@given(
    st.fixed_dictionaries(
        {
            "timestamp": st.integers(1, 2**64 - 1),
            "single": SINGLES,
            "wide": WIDE,
            "pair": st.tuples(SINGLES, SINGLES),
            "raw": st.binary(min_size=2, max_size=2),
            "label": st.text("abcXYZ019 \"\\'", max_size=4),
            "letter": st.integers(0, 255),
            "flags": st.tuples(st.booleans(), st.booleans()),
            "low": st.integers(-(2**63), 2**63 - 1),
        }
    )
)
def test_json_reads_back_as_the_same_bytes(fields: dict[str, Any]) -> None:
    """Every kind of field, NaN and infinities included; strict JSON on the way."""
    message = Whole(**fields)
    text = dumps(plain(message))
    json.loads(text, parse_constant=lambda name: pytest.fail(f"{name} is no JSON"))
    again = message_from(Whole, loads(text))
    first, second = (m.__uorb__.decode(m.__uorb__.encode(m, 0), 0) for m in (message, again))
    assert repr(first) == repr(second)


def test_text_escapes_what_steers_a_terminal() -> None:
    """A peer's text cannot move the cursor, in Latin-1's second control range neither."""
    received = Whole(timestamp=1, label='\x1b"\x9b\x7f')
    assert 'label: "\\u001b\\"\\u009b\\u007f"' in list(text_lines(received))


def test_arrays_of_messages_are_indented() -> None:
    """Each element below its index."""
    lines = list(text_lines(Whole(timestamp=1)))
    assert lines[-6:] == [
        *("inner[0]:", "  timestamp: 0", "  x: 0"),
        *("inner[1]:", "  timestamp: 0", "  x: 0"),
    ]
    assert "flags: [False, False]" in lines
