"""Frames survive the trip; what is no frame is refused, with WireError and nothing else."""

import tracemalloc

import pytest
from hypothesis import given
from hypothesis import strategies as st

from communicator import SampleHeader
from communicator.wire import (
    FRAME_HEADER_BYTES,
    MAX_FRAME,
    MAX_RECORDS,
    Record,
    WireError,
    pack_control_header,
    pack_frame_header,
    pack_sample_header,
    parse_frame,
)

U64 = st.integers(0, 2**64 - 1)
U32 = st.integers(0, 2**32 - 1)
SOURCE = bytes(range(8))


@st.composite
def records(draw: st.DrawFn) -> tuple[bytes, Record]:
    """One record's bytes, and what the parser makes of it in a frame sent at 0."""
    body = draw(st.binary(max_size=40))
    if draw(st.booleans()):
        return pack_control_header(len(body)) + body, Record(0, None, body)
    stream = draw(st.integers(0, 0xFFFF))
    header = SampleHeader(draw(U64), draw(U64), 0, draw(U32), draw(st.booleans()))
    return pack_sample_header(stream, header, len(body)) + body, Record(stream, header, body)


@st.composite
def frames(draw: st.DrawFn) -> tuple[bytes, list[Record]]:
    """One frame and its records."""
    made = draw(st.lists(records(), min_size=1, max_size=6))
    return pack_frame_header(SOURCE, 0) + b"".join(data for data, _ in made), [record for _, record in made]


def parses(data: bytes) -> bool:
    """Tell whether the parser takes the frame; anything but WireError fails the test."""
    try:
        parse_frame(data)
    except WireError:
        return False
    return True


@given(frames())
def test_a_frame_gives_back_its_records(made: tuple[bytes, list[Record]]) -> None:
    frame = parse_frame(made[0])
    assert (frame.source, frame.sent_us, frame.records) == (SOURCE, 0, made[1])


@given(frames(), st.data())
def test_a_frame_cut_short_is_refused_whole_or_ends_at_a_record(
    made: tuple[bytes, list[Record]], data: st.DataObject
) -> None:
    size = data.draw(st.integers(0, len(made[0]) - 1))
    if parses(made[0][:size]):
        assert parse_frame(made[0][:size]).records == made[1][: len(parse_frame(made[0][:size]).records)]


@given(frames(), st.data())
def test_mutated_frames_raise_nothing_but_wire_error(made: tuple[bytes, list[Record]], data: st.DataObject) -> None:
    frame = bytearray(made[0])
    for _ in range(data.draw(st.integers(1, 4))):
        frame[data.draw(st.integers(0, len(frame) - 1))] = data.draw(st.integers(0, 255))
    parses(bytes(frame))


@given(frames(), st.binary(min_size=1, max_size=7))
def test_a_frame_with_a_tail_is_refused(made: tuple[bytes, list[Record]], tail: bytes) -> None:
    assert not parses(made[0] + tail)  # a record has 8 bytes at least


@given(st.binary(max_size=200))
def test_garbage_is_refused(data: bytes) -> None:
    assert not parses(data)


@given(st.binary(max_size=200))
def test_garbage_after_a_good_header_raises_nothing_but_wire_error(data: bytes) -> None:
    parses(pack_frame_header(SOURCE, 1) + data)


@pytest.mark.parametrize(
    ("sent_us", "published_us", "age_us"), [(100, 40, 60), (40, 100, 0), (2**64 - 1, 0, 2**64 - 1)]
)
def test_age_is_time_from_publication_to_sending_and_never_negative(
    sent_us: int, published_us: int, age_us: int
) -> None:
    data = pack_frame_header(SOURCE, sent_us) + pack_sample_header(1, SampleHeader(1, published_us), 0)
    header = parse_frame(data).records[0].header
    assert header is not None
    assert header.age_us == age_us


def test_another_version_is_refused() -> None:
    data = pack_frame_header(SOURCE, 1) + pack_control_header(0)
    assert parses(data)
    assert not parses(data[:3] + b"\x02" + data[4:])


def test_a_frame_without_records_is_refused() -> None:
    assert not parses(pack_frame_header(SOURCE, 1))


@pytest.mark.parametrize("offset", [1, 2, 3])
def test_reserved_bits_are_refused(offset: int) -> None:
    frame = bytearray(pack_frame_header(SOURCE, 1) + pack_control_header(0))
    frame[FRAME_HEADER_BYTES + offset] = 2
    assert not parses(bytes(frame))


def test_records_beyond_the_limit_are_refused() -> None:
    head = pack_frame_header(SOURCE, 1)
    assert parses(head + pack_control_header(0) * MAX_RECORDS)
    assert not parses(head + pack_control_header(0) * (MAX_RECORDS + 1))


def test_hostile_lengths_allocate_next_to_nothing() -> None:
    claims = [
        pack_control_header(0xFFFFFFFF) + b"x",
        pack_sample_header(0, SampleHeader(1, 1), 0xFFFFFFFF) + b"x",
        pack_control_header(0) * 100_000,
    ]
    for claim in claims:
        frame = pack_frame_header(SOURCE, 1) + claim
        tracemalloc.start()
        assert not parses(frame)
        assert tracemalloc.get_traced_memory()[1] < 2_000_000
        tracemalloc.stop()


def test_a_frame_beyond_the_size_limit_is_refused() -> None:
    size = MAX_FRAME + 1 - FRAME_HEADER_BYTES - 8
    assert not parses(pack_frame_header(SOURCE, 1) + pack_control_header(size) + bytes(size))


@pytest.mark.parametrize("header", [SampleHeader(-1, 0), SampleHeader(1, 2**64), SampleHeader(1, 1, 0, -1)])
def test_a_header_that_fits_no_field_is_misuse(header: SampleHeader) -> None:
    with pytest.raises(ValueError, match="out of range"):
        pack_sample_header(0, header, 0)
