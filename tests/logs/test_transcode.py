"""Definitions and encodings made from ULog formats, judged by rosbags and pyulog."""

import math
import random
import struct
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pyulog import ULog
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from uorb_net.logs.formats import SIZES, Field, Format, leaves, measure, parse_format
from uorb_net.logs.transcode import (
    SEPARATOR,
    Transcoder,
    definition_text,
    field_names,
    topic_names,
    type_names,
)
from uorb_net.logs.ulog import Data, LogError, ULogReader

REAL = Path(__file__).resolve().parents[3] / "shared" / "ulg"
NAMES = (
    "mcap_example_test_ulog",
    "pyulog_sample",
    "pyulog_sample_log_small",
    "pyulog_sample_appended_multiple",
)
ROWS_COMPARED = 12


def formats_of(*texts: str) -> dict[str, Format]:
    """Return formats by name."""
    return {fmt.name: fmt for fmt in map(parse_format, texts)}


def decoder(coder: Transcoder) -> Callable[[bytes], Any]:
    """Return rosbags' decoder for a transcoder's definition."""
    store = get_typestore(Stores.EMPTY)
    name = f"px4_msgs/msg/{coder.type_name}"
    store.register(get_types_from_msg(coder.definition, name))
    return lambda payload: store.deserialize_cdr(payload, name)


def value_at(message: Any, path: str) -> Any:
    """Follow a path such as ``esc[2].q[1]`` into a decoded message."""
    for part in path.split("."):
        name, _, index = part.rstrip("]").partition("[")
        message = getattr(message, name)
        message = message[int(index)] if index else message
    return message


def same(ours: Any, theirs: Any) -> bool:
    """Whether two numbers are equal, NaN equal to NaN.

    pyulog shows booleans and characters as ``int8``: their bytes are compared.
    """
    if getattr(theirs, "dtype", None) == np.int8:
        return int(ours) & 0xFF == int(theirs) & 0xFF
    return bool(ours == theirs) or (math.isnan(ours) and math.isnan(theirs))


def reference(name: str, formats: dict[str, Format], row: bytes) -> bytes:
    """Encode primitive by primitive, for formats that all have a timestamp."""
    body = b""
    for leaf in leaves(name, formats):
        size = SIZES[leaf.type]
        body += bytes(-len(body) % size) + row[leaf.at : leaf.at + size * (leaf.count or 1)]
    return b"\x00\x01\x00\x00" + body


def first_rows(path: Path) -> Iterator[tuple[tuple[str, int], int, Data, dict[str, Format]]]:
    """Yield series, row number, row and formats of the first rows of each series."""
    seen: dict[tuple[str, int], int] = {}
    with ULogReader(path) as log:
        for record in log:
            if isinstance(record, Data):
                key = record.series.topic, record.series.instance
                seen[key] = seen.get(key, -1) + 1
                if seen[key] < ROWS_COMPARED:
                    yield key, seen[key], record, log.formats


# -- real logs ---------------------------------------------------------------------------------


@pytest.mark.parametrize("name", NAMES)
def test_rosbags_reads_what_pyulog_reads(name: str) -> None:
    """Every type of every real log: the message rosbags decodes holds pyulog's values."""
    path = REAL / f"{name}.ulg"
    if not path.exists():
        pytest.skip(f"no real flight log {path.name} beside the repository")
    judge = {(data.name, data.multi_id): data.data for data in ULog(str(path)).data_list}
    decoders: dict[str, tuple[Transcoder, Callable[[bytes], Any]]] = {}
    for key, at, record, formats in first_rows(path):
        if key[0] not in decoders:
            coder = Transcoder(key[0], formats)
            decoders[key[0]] = coder, decoder(coder)
        coder, decode = decoders[key[0]]
        payload = coder.encode(record.row)
        assert len(payload) == coder.encoded_size
        message = decode(payload)
        for name_in_log, column in judge[key].items():
            if "_padding" not in name_in_log:
                assert same(value_at(message, name_in_log), column[at]), f"{key} {name_in_log}"
    assert len(decoders) == len({topic for topic, _ in judge})


@pytest.mark.parametrize("name", NAMES)
def test_every_format_of_a_real_log_has_a_definition(name: str) -> None:
    """Also the formats without rows; the names are CamelCase and all different."""
    path = REAL / f"{name}.ulg"
    if not path.exists():
        pytest.skip(f"no real flight log {path.name} beside the repository")
    with ULogReader(path) as log:
        names = type_names(log.formats)
        assert len(set(names.values())) == len(names)
        for topic in log.formats:
            get_types_from_msg(definition_text(topic, log.formats), f"px4_msgs/msg/{names[topic]}")


# -- definitions -------------------------------------------------------------------------------


def test_definition_text() -> None:
    """Own text, then each nested type once through all levels; padding is gone, order stays."""
    formats = formats_of(
        "mid:uint64_t timestamp;inner[2] pair;uint8_t[7] _padding0;",
        "top_one:uint64_t timestamp;double d;float[3] f;mid m;inner i;char[9] call;bool b;int8_t c;",
        "inner:uint64_t timestamp;char c;uint8_t[7] _padding0;",
    )
    assert definition_text("top_one", formats) == (
        "# TOPICS top_one\nuint64 timestamp\nfloat64 d\nfloat32[3] f\nMid m\nInner i\nchar[9] call\nbool b\n"
        f"int8 c\n{SEPARATOR}\nMSG: px4_msgs/Mid\n# TOPICS mid\nuint64 timestamp\nInner[2] pair\n"
        f"{SEPARATOR}\nMSG: px4_msgs/Inner\n# TOPICS inner\nuint64 timestamp\nchar c\n"
    )


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("sensor_combined", "SensorCombined"),
        ("gps_2_raw", "Gps2Raw"),
        ("already_Camel", "AlreadyCamel"),
        ("SensorGps", "SensorGps"),
        ("a-b/c__d", "ABCD"),
        ("3d_fix", "T3dFix"),
        ("_", "T"),
        ("none", "TNone"),
    ],
)
def test_type_names(name: str, expected: str) -> None:
    """Words joined, each with a capital; what no type name may be is mended."""
    assert type_names([name]) == {name: expected}


def test_type_names_that_meet_are_kept_apart() -> None:
    """Two formats never share a type."""
    assert type_names(["a_1", "a1", "a__1"]) == {"a_1": "A1", "a1": "A1X2", "a__1": "A1X3"}


def test_topic_names() -> None:
    """A topic is called as in the log, unless that is no name a topic can have."""
    names = ["a-b", "a_b", "3d_fix", "vehicle/pose", "GpsRaw", "class"]
    mended = ["a_b_2", "a_b", "f_3d_fix", "vehicle_pose", "GpsRaw", "class"]
    assert topic_names(names) == dict(zip(names, mended))
    coder = Transcoder("a-b", formats_of("a-b:uint64_t timestamp;"))
    assert (coder.topic, coder.type_name) == ("a_b", "AB")
    assert coder.definition.startswith("# TOPICS a_b\n")


@pytest.mark.parametrize(
    ("raw", "expected"),
    [
        (["timestamp", "x", "R_body"], ["timestamp", "x", "R_body"]),
        (["a-b", "a/b", "a_b"], ["a_b_2", "a_b_3", "a_b"]),
        (["3d", "class", "__init__", "é"], ["f_3d", "class_", "init__", "f_"]),
        (["_timestamp", "timestamp"], ["timestamp_2", "timestamp"]),
        (["twice", "twice", "_padding0"], ["twice", "twice_2"]),
    ],
)
def test_field_names(raw: list[str], expected: list[str]) -> None:
    """Names no definition can have are mended; good ones keep theirs."""
    found = field_names([Field("float", 0, name) for name in raw])
    assert found == expected
    assert all(name.isidentifier() for name in found)


def test_a_missing_timestamp_is_written_out_and_zero() -> None:
    """The grammar adds one to such a type, nested or not, so the encoding holds it as zero."""
    formats = formats_of("top:uint8_t a;bare[2] b;", "bare:float x;")
    coder = Transcoder("top", formats)
    assert coder.definition.count("uint64 timestamp\n") == 2
    payload = coder.encode(b"\x07" + struct.pack("<2f", 1.5, 2.5))
    assert payload == b"\x00\x01\x00\x00" + struct.pack("<QB7xQf4xQf", 0, 7, 0, 1.5, 0, 2.5)
    message = decoder(coder)(payload)
    assert (message.a, message.b[1].timestamp, message.b[1].x) == (7, 0, 2.5)


def test_unusable_formats_are_log_errors() -> None:
    """Missing nested formats and circles are refused."""
    with pytest.raises(LogError, match="no format gone"):
        Transcoder("a", formats_of("a:gone x;"))
    with pytest.raises(LogError, match="contains itself"):
        definition_text("a", formats_of("a:a x;"))


# -- rows --------------------------------------------------------------------------------------


def test_padding_is_skipped_and_alignment_inserted() -> None:
    """The log's holes vanish, XCDR1's appear, counted from behind the header."""
    coder = Transcoder(
        "t",
        formats_of("t:uint8_t a;uint8_t[3] _padding0;uint64_t timestamp;uint8_t b;uint8_t[1] _padding1;float f;"),
    )
    row = b"\x01" + b"\xee" * 3 + struct.pack("<Q", 99) + b"\x02" + b"\xee" + struct.pack("<f", 0.5)
    assert coder.encode(row) == b"\x00\x01\x00\x00" + struct.pack("<B7xQB3xf", 1, 99, 2, 0.5)


def test_every_bit_survives() -> None:
    """Signalling NaNs, odd booleans and a timestamp of zero pass as they are."""
    coder = Transcoder("t", formats_of("t:uint64_t timestamp;float f;bool b;"))
    row = bytes(8) + b"\x01\x00\xa0\x7f" + b"\x42"
    assert coder.encode(row) == b"\x00\x01\x00\x00" + row


def test_rows_may_lack_the_padding_at_their_end() -> None:
    """All lengths from the last field to the full row give the same message; shorter is refused."""
    coder = Transcoder(
        "t",
        formats_of("t:uint64_t timestamp;sub s;", "sub:uint64_t timestamp;uint8_t a;uint8_t[7] _padding0;"),
    )
    full = bytes(range(24))
    assert {coder.encode(full[:size]) for size in range(17, 25)} == {b"\x00\x01\x00\x00" + full[:17]}
    with pytest.raises(LogError, match="has 16 bytes"):
        coder.encode(full[:16])


PRIMITIVE = st.sampled_from(sorted(SIZES))
COUNT = st.sampled_from([0, 0, 1, 2, 3, 5])


@st.composite
def format_trees(draw: st.DrawFn) -> dict[str, Format]:
    """Three formats, each nesting the next ones here and there, padding anywhere."""
    formats: dict[str, Format] = {}
    for level, inner in (("c", ()), ("b", ("c",)), ("a", ("b", "c"))):
        types = st.one_of(PRIMITIVE, PRIMITIVE, st.sampled_from(inner)) if inner else PRIMITIVE
        members: Iterable[tuple[str, int, bool]] = draw(
            st.lists(st.tuples(types, COUNT, st.booleans()), min_size=1, max_size=6)
        )
        fields = [
            Field("uint8_t", count, f"_padding{i}") if padding and count else Field(kind, count, f"x{i}")
            for i, (kind, count, padding) in enumerate(members)
        ]
        fields.insert(draw(st.integers(0, len(fields))), Field("uint64_t", 0, "timestamp"))
        formats[level] = Format(level, tuple(fields))
    return formats


@settings(max_examples=150, deadline=None)
@given(formats=format_trees(), seed=st.integers(0, 1 << 30))
def test_any_format_is_encoded_byte_for_byte(formats: dict[str, Format], seed: int) -> None:
    """Random bits in random formats: as the plain reference, and as rosbags would write them."""
    row = random.Random(seed).randbytes(measure("a", formats).size)
    coder = Transcoder("a", formats)
    payload = coder.encode(row)
    assert payload == reference("a", formats, row)
    assert len(payload) == coder.encoded_size


@settings(max_examples=40, deadline=None)
@given(formats=format_trees())
def test_rosbags_writes_the_same_bytes(formats: dict[str, Format]) -> None:
    """What rosbags decodes, it encodes to the same message (of small numbers: no odd booleans)."""
    coder = Transcoder("a", formats)
    payload = coder.encode(bytes([1]) * measure("a", formats).size)
    store = get_typestore(Stores.EMPTY)
    name = f"px4_msgs/msg/{coder.type_name}"
    store.register(get_types_from_msg(coder.definition, name))
    assert bytes(store.serialize_cdr(store.deserialize_cdr(payload, name), name)) == payload
