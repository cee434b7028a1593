"""The ULog reader against pyulog on real flight logs, and on small logs damaged in every way."""

import random
import struct
import tracemalloc
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pyulog import ULog

from uorb_net.logs.formats import Field, Layout, Leaf, leaves, measure, parse_format
from uorb_net.logs.ulog import (
    Data,
    Dropout,
    LogError,
    Logged,
    Parameter,
    Record,
    SeriesSummary,
    Subscription,
    ULogReader,
    summary,
)

REAL = Path(__file__).resolve().parents[3] / "shared" / "ulg"
NAMES = (
    "mcap_example_test_ulog",
    "pyulog_sample",
    "pyulog_sample_log_small",
    "pyulog_sample_appended_multiple",
)
NUMPY = {
    "int8_t": "i1",
    "uint8_t": "u1",
    "int16_t": "<i2",
    "uint16_t": "<u2",
    "int32_t": "<i4",
    "uint32_t": "<u4",
    "int64_t": "<i8",
    "uint64_t": "<u8",
    "float": "<f4",
    "double": "<f8",
    "bool": "i1",
    "char": "i1",
}
SeriesKey = tuple[str, int]
MakeLog = Callable[..., bytes]

FORMAT = ("F", "pair:uint64_t timestamp;float x;uint8_t flag;uint8_t[3] _padding0;")


def row(timestamp_us: int, x: float = 1.5, flag: int = 7) -> bytes:
    """Return a row of ``pair`` without the padding at its end."""
    return struct.pack("<QfB", timestamp_us, x, flag)


def real(name: str) -> Path:
    """Return a real log's path, or skip."""
    path = REAL / f"{name}.ulg"
    if not path.exists():
        pytest.skip(f"no real flight log {path.name} beside the repository")
    return path


def write(folder: Path, content: bytes) -> Path:
    """Store a log."""
    path = folder / "log.ulg"
    path.write_bytes(content)
    return path


def read(path: Path) -> tuple[ULogReader, list[Record]]:
    """Read a log through."""
    with ULogReader(path) as log:
        return log, list(log)


def timestamps(records: list[Record]) -> list[int]:
    """Return the rows' timestamps."""
    return [record.timestamp_us for record in records if isinstance(record, Data)]


def columns(log: ULogReader, topic: str, rows: list[bytes]) -> dict[str, Any]:
    """Decode rows into an array for each primitive, named as pyulog names them."""
    size = measure(topic, log.formats).size
    table = np.frombuffer(b"".join(r.ljust(size, b"\0") for r in rows), np.uint8).reshape(len(rows), size)
    found: dict[str, Any] = {}
    for leaf in leaves(topic, log.formats):
        dtype = np.dtype(NUMPY[leaf.type])
        for i in range(leaf.count or 1):
            at = leaf.at + i * dtype.itemsize
            part = np.ascontiguousarray(table[:, at : at + dtype.itemsize]).view(dtype)[:, 0]
            found[f"{leaf.path}[{i}]" if leaf.count else leaf.path] = part
    return found


# -- real logs against pyulog ------------------------------------------------------------------


@pytest.mark.parametrize("name", NAMES)
def test_every_value_of_a_real_log_is_pyulogs(name: str) -> None:
    """Topics, instances, row counts and every field's every bit are the same."""
    judge = ULog(str(real(name)))
    log, records = read(real(name))
    rows: dict[SeriesKey, list[bytes]] = {}
    for record in records:
        if isinstance(record, Data):
            rows.setdefault((record.series.topic, record.series.instance), []).append(record.row)
    assert set(rows) == {(data.name, data.multi_id) for data in judge.data_list}
    for data in judge.data_list:
        ours = columns(log, data.name, rows[data.name, data.multi_id])
        theirs = {key: array for key, array in data.data.items() if "_padding" not in key}
        assert list(ours) == list(theirs)
        for key, array in theirs.items():
            assert ours[key].tobytes() == array.tobytes(), f"{data.name}.{key}"


@pytest.mark.parametrize("name", NAMES)
def test_everything_beside_the_rows_is_pyulogs(name: str) -> None:
    """Header, information, parameters, dropouts and texts are the same, and no fault is seen."""
    judge = ULog(str(real(name)))
    log, records = read(real(name))
    assert (log.start_us, log.last_us) == (judge.start_timestamp, judge.last_timestamp)
    assert list(log.compat_flags) == judge._compat_flags
    assert list(log.appended_offsets) == judge._appended_offsets
    assert log.info == judge.msg_info_dict
    assert log.multi_info == judge.msg_info_multiple_dict
    assert log.parameters == judge.initial_parameters
    assert log.default_parameters == judge._default_parameters
    changed = [(r.timestamp_us, r.name, r.value) for r in records if isinstance(r, Parameter)]
    assert changed == judge.changed_parameters
    dropouts = [(r.timestamp_us, r.duration_ms) for r in records if isinstance(r, Dropout)]
    assert dropouts == [(d.timestamp, d.duration) for d in judge.dropouts]
    texts = [(r.level + 48, r.timestamp_us, r.text) for r in records if isinstance(r, Logged)]
    assert texts == [(m.log_level, m.timestamp, m.message) for m in judge.logged_messages]
    assert (log.faults, log.problem, log.truncated) == (0, "", False)
    assert log.position == log.size == real(name).stat().st_size


@pytest.mark.parametrize("name", NAMES)
def test_summary_of_a_real_log(name: str) -> None:
    """The summary counts what pyulog counts; series without rows are listed too."""
    judge = ULog(str(real(name)))
    whole = summary(real(name))
    expected = {
        (d.name, d.multi_id): (len(d.data["timestamp"]), d.data["timestamp"][0], d.data["timestamp"][-1])
        for d in judge.data_list
    }
    found = {(s.topic, s.instance): (s.rows, s.first_us, s.last_us) for s in whole.series if s.rows}
    assert found == expected
    assert whole.duration_us() == judge.last_timestamp - judge.start_timestamp
    assert (whole.dropouts, whole.dropout_ms) == (
        len(judge.dropouts),
        sum(d.duration for d in judge.dropouts),
    )


def test_memory_stays_bounded() -> None:
    """Reading 4 MB takes a small part of it, whatever the log's length."""
    path = real("pyulog_sample")
    tracemalloc.start()
    try:
        summary(path)
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak < 600_000


# -- what a log can hold -----------------------------------------------------------------------


def test_records_of_a_small_log(tmp_path: Path, make_log: MakeLog, sync: bytes) -> None:
    """Every kind of message becomes its record, in file order."""
    content = make_log(
        FORMAT,
        ("I", "char[3] sys_name", b"PX4"),
        ("I", "uint32_t ver", struct.pack("<I", 9)),
        ("I", "uint8_t[2] blob", b"\x01\x02"),
        ("M", 0, "char[1] part", b"a"),
        ("M", 1, "char[1] part", b"b"),
        ("M", 0, "char[1] part", b"c"),
        ("P", "int32_t A", struct.pack("<i", -5)),
        ("Q", 3, "float B", struct.pack("<f", 0.5)),
        ("A", 2, 11, "pair"),
        ("D", 11, row(1_500_000)),
        ("L", ord("4"), 1_500_001, "careful"),
        ("C", ord("6"), 77, 1_500_002, "tagged"),
        sync,
        ("O", 120),
        ("P", "float B", struct.pack("<f", 0.25)),
        ("D", 11, row(1_400_000) + bytes(3)),
    )
    log, records = read(write(tmp_path, content))
    series = Subscription(11, "pair", 2)
    assert records == [
        series,
        Data(series, 1_500_000, row(1_500_000)),
        Logged(4, 1_500_001, "careful"),
        Logged(6, 1_500_002, "tagged", 77),
        Dropout(1_500_000, 120),
        Parameter(1_500_000, "B", 0.25),
        Data(series, 1_400_000, row(1_400_000) + bytes(3)),
    ]
    assert log.info == {"sys_name": "PX4", "ver": 9, "blob": b"\x01\x02"}
    assert log.multi_info == {"part": [["a", "b"], ["c"]]}
    assert log.parameters == {"A": -5}
    assert log.default_parameters == {0: {"B": 0.5}, 1: {"B": 0.5}}
    assert (log.start_us, log.last_us, log.duration_us()) == (1_000_000, 1_500_000, 500_000)
    assert (log.faults, log.truncated) == (0, False)


def test_definitions_are_there_before_iteration(tmp_path: Path, make_log: MakeLog) -> None:
    """Opening a log reads its formats and information, and no record."""
    path = write(tmp_path, make_log(FORMAT, ("I", "bool ok", b"\x01"), ("A", 0, 1, "pair")))
    with ULogReader(path) as log:
        assert log.formats["pair"].fields[-1] == Field("uint8_t", 3, "_padding0")
        assert log.info == {"ok": True}
        assert log.position < log.size


def test_nested_layout() -> None:
    """Nested members lie in place; padding takes room and is no field; the last one may be absent."""
    texts = (
        "top:uint8_t a;sub[2] s;sub last;uint8_t[2] _padding0;",
        "sub:uint64_t timestamp;char[3] c;uint8_t[5] _padding0;",
    )
    formats = {fmt.name: fmt for fmt in map(parse_format, texts)}
    assert measure("top", formats) == Layout(1 + 3 * 16 + 2, 1 + 2 * 16 + 11, -1, "")
    assert list(leaves("top", formats)) == [
        Leaf("a", "uint8_t", 0, 0),
        Leaf("s[0].timestamp", "uint64_t", 0, 1),
        Leaf("s[0].c", "char", 3, 9),
        Leaf("s[1].timestamp", "uint64_t", 0, 17),
        Leaf("s[1].c", "char", 3, 25),
        Leaf("last.timestamp", "uint64_t", 0, 33),
        Leaf("last.c", "char", 3, 41),
    ]


@pytest.mark.parametrize(
    "texts",
    [
        ("a:a x;",),
        ("a:b x;", "b:a x;"),
        ("a:nobody x;",),
        ("a:",),
        ("a:uint8_t[4] _padding0;",),
        ("a:uint64_t[9000] x;",),
        ("a:b[60000] x;", "b:c[60000] x;", "c:uint8_t[60000] x;"),
        (*(f"f{i}:" + f"f{i + 1} x;" * 9 for i in range(16)), "f16:uint8_t x;"),
    ],
    ids=["itself", "circle", "unknown", "empty", "padding", "long", "huge", "bushy"],
)
def test_hopeless_formats_are_refused(tmp_path: Path, make_log: MakeLog, texts: tuple[str, ...]) -> None:
    """A format without a layout costs its series alone, and no time to speak of."""
    name = texts[0].split(":")[0]
    messages = [("F", text) for text in texts]
    content = make_log(FORMAT, *messages, ("A", 0, 1, name), ("A", 0, 2, "pair"), ("D", 2, row(5)))
    log, records = read(write(tmp_path, content))
    assert timestamps(records) == [5]
    assert log.faults >= 1
    assert log.problem.startswith("byte ")


def test_appended_data_follows_in_order(tmp_path: Path, make_log: MakeLog, message: MakeLog) -> None:
    """Each section is read to its end; a message cut by a crash does not spoil what was appended."""
    flags = struct.Struct("<8x8s3Q")

    def main(*offsets: int) -> bytes:
        head = message("B", flags.pack(bytes([1]) + bytes(7), *offsets))
        return make_log(head, FORMAT, ("A", 0, 1, "pair"), ("D", 1, row(1))) + message("D", 1, row(2))[:9]

    first, second = message("D", 1, row(3)), message("I", "char[1] k", b"v") + message("D", 1, row(4))
    size = len(main(0, 0, 0))
    content = main(size, size + len(first), 0) + first + second
    log, records = read(write(tmp_path, content))
    assert timestamps(records) == [1, 3, 4]
    assert log.appended_offsets == (size, size + len(first))
    assert log.info == {"k": "v"}
    assert log.truncated
    assert log.problem == f"byte {size - 9}: the log ends inside a message"


@pytest.mark.parametrize("offsets", [(1 << 60, 0, 0), (3, 0, 0), (90, 80, 0)])
def test_false_appended_offsets_do_no_harm(
    tmp_path: Path, make_log: MakeLog, message: MakeLog, offsets: tuple[int, int, int]
) -> None:
    """Offsets outside the file or out of order are a fault; the rows are read once all the same."""
    head = message("B", struct.pack("<8x8s3Q", bytes([1]) + bytes(7), *offsets))
    rows = [("D", 1, row(n)) for n in range(1, 9)]
    log, records = read(write(tmp_path, make_log(head, FORMAT, ("A", 0, 1, "pair"), *rows)))
    assert timestamps(records)[-6:] == [3, 4, 5, 6, 7, 8]
    assert len(timestamps(records)) <= 8
    assert log.faults


def test_incompatible_flags_are_refused(tmp_path: Path, make_log: MakeLog, message: MakeLog) -> None:
    """A log that says older readers cannot read it is not read."""
    head = message("B", struct.pack("<8x8s3Q", bytes([3]) + bytes(7), 0, 0, 0))
    with pytest.raises(LogError, match="newer reader"):
        ULogReader(write(tmp_path, make_log(head, FORMAT)))


@pytest.mark.parametrize("content", [b"", b"ULog", b"\x89MCAP0\r\n", b"not a log at all" * 9])
def test_other_files_are_refused(tmp_path: Path, content: bytes) -> None:
    """What does not begin as a ULog is no log."""
    with pytest.raises(LogError, match="not a ULog"):
        ULogReader(write(tmp_path, content))


def test_a_missing_file_is_an_os_error(tmp_path: Path) -> None:
    """The system's own error says so."""
    with pytest.raises(FileNotFoundError):
        ULogReader(tmp_path / "absent.ulg")


def test_a_msg_id_may_be_given_anew(tmp_path: Path, make_log: MakeLog) -> None:
    """Rows belong to the latest subscription of their id, and to none after its removal."""
    content = make_log(
        FORMAT,
        ("A", 0, 1, "pair"),
        ("D", 1, row(1)),
        ("A", 1, 1, "pair"),
        ("D", 1, row(2)),
        ("R", 1),
        ("D", 1, row(3)),
        ("A", 2, 1, "pair"),
        ("D", 1, row(4)),
    )
    log, records = read(write(tmp_path, content))
    assert [r.series.instance for r in records if isinstance(r, Data)] == [0, 1, 2]
    assert log.faults == 1


def test_a_row_without_timestamp_takes_the_latest(tmp_path: Path, make_log: MakeLog) -> None:
    """It stays among its neighbours."""
    content = make_log(
        FORMAT, ("F", "bare:float x;"), ("A", 0, 1, "pair"), ("A", 0, 2, "bare"), ("D", 2, bytes(4)),
        ("D", 1, row(1_200_000)), ("D", 2, bytes(4)),
    )  # fmt: skip
    _, records = read(write(tmp_path, content))
    assert timestamps(records) == [1_000_000, 1_200_000, 1_200_000]


def test_summary_of_a_small_log(tmp_path: Path, make_log: MakeLog) -> None:
    """Subscriptions of one topic and instance are one series, whatever their ids."""
    content = make_log(
        FORMAT,
        ("A", 0, 1, "pair"),
        ("A", 3, 2, "pair"),
        ("D", 1, row(1)),
        ("A", 0, 5, "pair"),
        ("D", 5, row(9)),
    )
    whole = summary(write(tmp_path, content))
    assert whole.series == (SeriesSummary("pair", 0, 2, 1, 9), SeriesSummary("pair", 3, 0, None, None))
    assert whole.duration_us() == 0


# -- damage ------------------------------------------------------------------------------------


def small_log(make_log: MakeLog) -> tuple[bytes, list[int]]:
    """Return a log of ten rows and some company, and the offset at which each row ends."""
    content = make_log(FORMAT, ("I", "char[3] sys_name", b"PX4"), ("A", 0, 1, "pair"))
    ends = []
    for n in range(10):
        content += make_log(("D", 1, row(1_000_000 + n)))[16:]
        ends.append(len(content))
        if n % 3 == 0:
            content += make_log(("L", ord("6"), n, "text"), ("O", 5))[16:]
    return content, ends


def test_a_log_cut_at_any_byte_yields_every_whole_row(tmp_path: Path, make_log: MakeLog) -> None:
    """The rows before the cut come, and unless it falls between messages the reader says where."""
    content, ends = small_log(make_log)
    whole = {16}
    at = 16
    while at < len(content):
        at += 3 + int.from_bytes(content[at : at + 2], "little")
        whole.add(at)
    for cut in range(7, len(content) + 1):
        log, records = read(write(tmp_path, content[:cut]))
        assert timestamps(records) == [1_000_000 + n for n, end in enumerate(ends) if end <= cut]
        assert log.truncated == (cut not in whole), cut
        last = max((end for end in whole if end <= cut), default=0)
        assert log.problem == ("" if cut in whole else f"byte {last}: the log ends inside a message")


def test_garbage_anywhere_costs_no_row(tmp_path: Path, make_log: MakeLog) -> None:
    """Bytes put in between two messages are skipped, whatever they are."""
    content, ends = small_log(make_log)
    dice = random.Random(5)
    fillings = [b"\0" * 40, b"\xff" * 300, b"D" * 17, *(dice.randbytes(n) for n in (1, 2, 3, 9, 80, 5000))]
    for filling in fillings:
        for at in ends[:-1]:
            log, records = read(write(tmp_path, content[:at] + filling + content[at:]))
            assert timestamps(records) == [1_000_000 + n for n in range(10)], (filling[:9], at)
            assert log.faults
            assert log.problem.startswith(f"byte {at}: ")


def test_a_changed_byte_costs_few_rows(tmp_path: Path, make_log: MakeLog) -> None:
    """A wrong byte in the data section loses the messages it touches, and nothing raises."""
    content, _ = small_log(make_log)
    for at in range(content.index(b"pair", 60) + 4, len(content)):
        broken = bytearray(content)
        broken[at] ^= 0x5A
        _, records = read(write(tmp_path, bytes(broken)))
        assert len(timestamps(records)) >= 8, at


def test_random_bytes_never_raise(tmp_path: Path, make_log: MakeLog) -> None:
    """Whatever follows a true header, the reader ends."""
    dice = random.Random(11)
    for size in (0, 1, 2, 3, 50, 500, 5000, 70_000):
        for _ in range(5):
            read(write(tmp_path, make_log(dice.randbytes(size))))


def test_a_megabyte_of_garbage_is_crossed(tmp_path: Path, make_log: MakeLog) -> None:
    """The search goes as far as it must, in bounded memory, and finds the rows behind."""
    content, ends = small_log(make_log)
    garbage = random.Random(3).randbytes(1 << 20)
    path = write(tmp_path, content[: ends[4]] + garbage + content[ends[4] :])
    tracemalloc.start()
    try:
        _, records = read(path)
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert timestamps(records) == [1_000_000 + n for n in range(10)]
    assert peak < 600_000


def test_unknown_kinds_are_passed_over(tmp_path: Path, make_log: MakeLog, message: MakeLog) -> None:
    """A newer writer's messages are no fault."""
    content, ends = small_log(make_log)
    log, records = read(write(tmp_path, content[: ends[2]] + message("Z", b"new things") + content[ends[2] :]))
    assert len(timestamps(records)) == 10
    assert (log.faults, log.problem) == (0, "")


@pytest.mark.parametrize("size", [2, 5, 14, 19, 200])
def test_rows_of_wrong_size_are_skipped(tmp_path: Path, make_log: MakeLog, message: MakeLog, size: int) -> None:
    """Too short or too long a row is a fault; its neighbours come."""
    content, ends = small_log(make_log)
    path = write(tmp_path, content[: ends[2]] + message("D", 1, bytes(size - 2)) + content[ends[2] :])
    log, records = read(path)
    assert len(timestamps(records)) == 10
    assert log.faults == 1


def test_a_damaged_real_log_keeps_almost_all(tmp_path: Path) -> None:
    """Holes of random bytes cost the rows they cover; pyulog loses as many or more."""
    clean = real("mcap_example_test_ulog").read_bytes()
    total = sum(series.rows for series in summary(real("mcap_example_test_ulog")).series)
    dice = random.Random(8)
    broken = bytearray(clean)
    for _ in range(20):
        at = dice.randrange(len(clean) // 2, len(clean) - 400)
        broken[at : at + 100] = dice.randbytes(100)
    path = write(tmp_path, bytes(broken))
    ours = summary(path)
    kept = sum(series.rows for series in ours.series)
    theirs = sum(len(data.data["timestamp"]) for data in ULog(str(path)).data_list)
    assert ours.faults >= 1
    assert kept >= theirs
    assert kept > total - 20 * 8


def test_what_is_kept_is_bounded(tmp_path: Path, make_log: MakeLog, message: MakeLog) -> None:
    """Information beyond the bound is dropped and said so; rows go on."""
    chunk = message("M", 1, "char[60000] flood", b"x" * 60_000)
    content, _ = small_log(make_log)
    log, records = read(write(tmp_path, content[:16] + chunk * 60 + content[16:]))
    assert sum(len(str(part)) for part in log.multi_info["flood"][0]) <= 2 << 20
    assert "not kept" in log.problem
    # The formats came after the flood here, so their rows are lost; the texts still come.
    assert [r.text for r in records if isinstance(r, Logged)] == ["text"] * 4


def test_a_format_does_not_change_under_its_rows(tmp_path: Path, make_log: MakeLog) -> None:
    """A late format is taken, one that contradicts an earlier one is a fault."""
    content = make_log(
        FORMAT,
        ("A", 0, 1, "pair"),
        ("F", "pair:uint8_t x;"),
        ("F", "late:uint64_t timestamp;"),
        ("A", 0, 2, "late"),
        ("D", 1, row(1)),
        ("D", 2, bytes(8)),
    )
    log, records = read(write(tmp_path, content))
    assert timestamps(records) == [1, 0]
    assert len(log.formats["pair"].fields) == 4
    assert log.faults == 1
