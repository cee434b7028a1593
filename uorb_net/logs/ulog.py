"""A streaming reader of PX4's ULog files: one message and a small buffer in memory, never the log.

Damage costs no more than it covers (``framing`` says how the reader finds its way again), and what
was wrong can be read from the reader afterwards.
"""

import os
import struct
from collections.abc import Iterator
from types import TracebackType
from typing import Self

import msgspec

from uorb_net.errors import UorbError
from uorb_net.logs.formats import Format, Layout, measure, parse_format
from uorb_net.logs.framing import BUFFER_BYTES, HEADER, Frames
from uorb_net.logs.records import (
    MSG_ID,
    Data,
    Dropout,
    Logged,
    Parameter,
    Record,
    Subscription,
    Value,
    key_value,
    logged,
)

__all__ = [
    "Data",
    "Dropout",
    "LogError",
    "Logged",
    "Parameter",
    "Record",
    "SeriesSummary",
    "Subscription",
    "Summary",
    "ULogReader",
    "Value",
    "summary",
]

MAGIC = b"ULog\x01\x12\x35"
_FILE_HEADER = 16
_FLAGS = struct.Struct("<8s8s3Q")
_DATA = ord("D")
# What is kept of formats, parameters, information: a real log has some 100 KB of it.
_KEPT_BYTES = 2 << 20


class LogError(UorbError, ValueError):
    """A file that is no log, a log from the future, or a row or format that cannot be read."""


class SeriesSummary(msgspec.Struct, frozen=True):
    """A series at a glance; the times (microseconds) are None without rows."""

    topic: str
    instance: int
    rows: int
    first_us: int | None
    last_us: int | None


class Summary(msgspec.Struct, frozen=True):
    """What a whole log holds, see ``summary``.

    Attributes:
        start_us: the log's start, as its header says.
        last_us: largest timestamp of a row.
        series: in the order of their first subscription, also those without rows.
        formats: as in ``ULogReader``, those that came late included.
        dropouts: their number.
        dropout_ms: their total duration.
        truncated, faults, problem: as in ``ULogReader``.
    """

    start_us: int
    last_us: int
    series: tuple[SeriesSummary, ...]
    formats: dict[str, Format]
    dropouts: int
    dropout_ms: int
    truncated: bool
    faults: int
    problem: str

    def duration_us(self) -> int:
        """Return the microseconds from the log's start to its last row."""
        return max(self.last_us - self.start_us, 0)


class _Route(msgspec.Struct, frozen=True):
    """What a msg_id leads to; sizes and offset are those of the whole data message's body."""

    series: Subscription
    least: int
    most: int
    timestamp_at: int
    timestamp: struct.Struct


class ULogReader:
    """Reads a log once from front to end: ``for record in log``.

    Header and definitions are read on construction; information, formats and parameter defaults
    that come later in the file are added as iteration meets them. Appended data follows in its order.

    Attributes:
        path: as given.
        size: bytes of the file when it was opened; what is written later is not read.
        version: of the file format.
        start_us: start of the log, microseconds of the vehicle's clock.
        last_us: largest timestamp of a row so far, at first ``start_us``.
        compat_flags, incompat_flags: eight bytes each.
        appended_offsets: where appended data begins, in bytes.
        formats: by name; a topic's name is its format's.
        info: information by key.
        multi_info: by key, a list of values, each a list of chunks.
        parameters: the initial values by name.
        default_parameters: by kind (0 the firmware's, 1 the present set-up's), then by name.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        """Open the log and read up to its first subscription, row or text.

        Raises:
            LogError: the file is no ULog, or needs a newer reader.
            OSError: the file cannot be read.
        """
        self.path = os.fspath(path)
        self.compat_flags = self.incompat_flags = bytes(8)
        self.appended_offsets: tuple[int, ...] = ()
        self.formats: dict[str, Format] = {}
        self.info: dict[str, Value] = {}
        self.multi_info: dict[str, list[list[Value]]] = {}
        self.parameters: dict[str, Value] = {}
        self.default_parameters: dict[int, dict[str, Value]] = {}
        self._kept_bytes = 0
        self._ends: list[int] = []
        self._routes: dict[int, _Route] = {}
        self._layouts: dict[str, Layout] = {}
        self._file = open(path, "rb", buffering=BUFFER_BYTES)  # noqa: SIM115 - closed by close()
        self._frames = Frames(self._file, self._row_fits)
        self.start_us = self.last_us = 0
        try:
            self.size = os.fstat(self._file.fileno()).st_size
            self._read_header()
            self._read_flags()
            self._read_definitions()
            self._ends = self._section_ends()
        except BaseException:
            self._file.close()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close the file; what was read stays."""
        self._file.close()

    @property
    def position(self) -> int:
        """Bytes of the file read so far."""
        return self._frames.position

    @property
    def truncated(self) -> bool:
        """Whether the file, or one of its sections, was found to end inside a message."""
        return self._frames.truncated

    @property
    def faults(self) -> int:
        """Number of damaged places met so far."""
        return self._frames.faults

    @property
    def problem(self) -> str:
        """The first fault in one line, with its byte offset; empty without any."""
        return self._frames.problem

    def duration_us(self) -> int:
        """Return the microseconds from the log's start to the last row read so far."""
        return max(self.last_us - self.start_us, 0)

    def __iter__(self) -> Iterator[Record]:
        """Yield what the data sections hold; a second iteration goes on where the first stopped."""
        while self._ends:
            while (message := self._frames.pull(self._ends[0])) is not None:
                kind, body = message
                record = self._row(body) if kind == _DATA else self._take(kind, body)
                if record is not None:
                    yield record
            self._frames.go(self._ends.pop(0))

    def _read_header(self) -> None:
        header = self._file.read(_FILE_HEADER)
        if header[:7] != MAGIC:
            raise LogError(f"{self.path} is not a ULog file")
        self.version, self.start_us = struct.unpack("<BQ", header[7:].ljust(9, b"\0"))
        self.last_us = self.start_us
        if len(header) < _FILE_HEADER:
            self._frames.cut(0, len(header))
        self._frames.position = len(header)

    def _read_flags(self) -> None:
        """Read the flags, which only the first message may hold, and go back to it."""
        head = self._file.read(HEADER.size + _FLAGS.size)
        self._frames.go(self.position)
        if len(head) < HEADER.size + _FLAGS.size:
            return
        size, kind = HEADER.unpack_from(head)
        if kind != ord("B") or size < _FLAGS.size:
            return
        self.compat_flags, self.incompat_flags, *offsets = _FLAGS.unpack_from(head, HEADER.size)
        if self.incompat_flags[0] & ~1 or any(self.incompat_flags[1:]):
            raise LogError(f"{self.path} needs a newer reader: incompatible flags {self.incompat_flags.hex()}")
        if self.incompat_flags[0]:
            self.appended_offsets = tuple(offset for offset in offsets if offset)

    def _section_ends(self) -> list[int]:
        """Return where the data section and each appended one end."""
        ends, last = [], self.position
        for offset in self.appended_offsets:
            if last < offset <= self.size:
                ends.append(last := offset)
            else:
                self._frames.truncated |= offset > self.size
                self._frames.fault(_FILE_HEADER, f"there is no appended data at byte {offset}")
        return [*ends, self.size]

    def _read_definitions(self) -> None:
        while (message := self._frames.pull(self.size)) is not None:
            kind, body = message
            if kind in b"ACDLO":
                self._frames.go(self._frames.at)
                return
            record = self._take(kind, body)
            if isinstance(record, Parameter) and self._keep(body):
                self.parameters[record.name] = record.value

    def _row_fits(self, body: bytes, size: int) -> bool:
        route = self._routes.get(MSG_ID.unpack_from(body)[0]) if len(body) > 1 else None
        return route is not None and route.least <= size <= route.most

    def _row(self, body: bytes) -> Data:
        route = self._routes[MSG_ID.unpack_from(body)[0]]
        if route.timestamp_at < 0:
            return Data(route.series, self.last_us, body[2:])
        (timestamp_us,) = route.timestamp.unpack_from(body, route.timestamp_at)
        self.last_us = max(self.last_us, timestamp_us)
        return Data(route.series, timestamp_us, body[2:])

    def _take(self, kind: int, body: bytes) -> Record | None:
        """Return the record of a message, or keep what it defines."""
        try:
            if kind in b"LC":
                return logged(body, tagged=kind == ord("C"))
            if kind == ord("O"):
                return Dropout(self.last_us, *MSG_ID.unpack(body))
            if kind == ord("P"):
                return Parameter(self.last_us, *key_value(body))
            if kind == ord("R"):
                self._routes.pop(MSG_ID.unpack(body)[0], None)
                return None
            return self._define(kind, body)
        except ValueError as error:
            self._frames.fault(self._frames.at, str(error))
            return None

    def _define(self, kind: int, body: bytes) -> Subscription | None:
        if kind in b"SB" or not self._keep(body):
            return None
        if kind == ord("A"):
            return self._subscribe(body)
        if kind == ord("F"):
            fmt = parse_format(body.decode("utf-8", "replace"))
            if self._ends and self.formats.get(fmt.name, fmt) != fmt:
                raise ValueError(f"format {fmt.name} changes after rows of it may have come")
            self.formats[fmt.name] = fmt
            self._layouts.clear()
        elif kind == ord("I"):
            key, value = key_value(body)
            self.info[key] = value
        elif kind == ord("M"):
            self._add_chunk(body)
        elif kind == ord("Q"):
            self._add_default(body)
        return None

    def _keep(self, body: bytes) -> bool:
        """Whether there is room to keep what this body defines."""
        self._kept_bytes += len(body)
        if self._kept_bytes <= _KEPT_BYTES:
            return True
        self._frames.fault(self._frames.at, f"definitions and information beyond {_KEPT_BYTES} bytes are not kept")
        return False

    def _subscribe(self, body: bytes) -> Subscription:
        instance, msg_id = struct.unpack_from("<BH", body)
        topic = body[3:].decode("ascii")
        # An id given anew must not lead to the series it meant before, even if this one is refused.
        self._routes.pop(msg_id, None)
        layout = self._layouts.get(topic)
        if layout is None:
            layout = self._layouts[topic] = measure(topic, self.formats)
        series = Subscription(msg_id, topic, instance)
        at = layout.timestamp_at + MSG_ID.size if layout.timestamp_at >= 0 else -1
        least, most = layout.needed + MSG_ID.size, layout.size + MSG_ID.size
        self._routes[msg_id] = _Route(series, least, most, at, struct.Struct(layout.timestamp_code))
        return series

    def _add_chunk(self, body: bytes) -> None:
        key, value = key_value(body[1:])
        values = self.multi_info.setdefault(key, [])
        if body[0] and values:
            values[-1].append(value)
        else:
            values.append([value])

    def _add_default(self, body: bytes) -> None:
        name, value = key_value(body[1:])
        for bit in range(8):
            if body[0] >> bit & 1:
                self.default_parameters.setdefault(bit, {})[name] = value


class _Tally:
    """Counts the rows of one series."""

    def __init__(self) -> None:
        self.rows = 0
        self.first_us: int | None = None
        self.last_us: int | None = None

    def add(self, timestamp_us: int) -> None:
        self.rows += 1
        if self.first_us is None:
            self.first_us = timestamp_us
        self.last_us = timestamp_us


def summary(path: str | os.PathLike[str]) -> Summary:
    """Read a log through and return what it holds; no row is kept.

    Raises:
        LogError: the file is no ULog, or needs a newer reader.
        OSError: the file cannot be read.
    """
    tallies: dict[tuple[str, int], _Tally] = {}
    dropouts = dropout_ms = 0
    with ULogReader(path) as log:
        for record in log:
            if isinstance(record, Data):
                tallies[record.series.topic, record.series.instance].add(record.timestamp_us)
            elif isinstance(record, Subscription):
                tallies.setdefault((record.topic, record.instance), _Tally())
            elif isinstance(record, Dropout):
                dropouts, dropout_ms = dropouts + 1, dropout_ms + record.duration_ms
    series = tuple(SeriesSummary(*key, t.rows, t.first_us, t.last_us) for key, t in tallies.items())
    return Summary(
        start_us=log.start_us,
        last_us=log.last_us,
        series=series,
        formats=log.formats,
        dropouts=dropouts,
        dropout_ms=dropout_ms,
        truncated=log.truncated,
        faults=log.faults,
        problem=log.problem,
    )
