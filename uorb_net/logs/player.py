"""The pacing of a played log, without a bus and without a clock of its own.

Clock, sleep and the sink that publishes are handed in. Time runs from the log's start; what is
older than its start, or than its predecessor, goes at once, in file order.
"""

import fnmatch
import math
import os
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import partial
from typing import NamedTuple, Protocol

import msgspec

from uorb_net.logs.records import Data, Record
from uorb_net.logs.transcode import Transcoder
from uorb_net.logs.ulog import Summary, ULogReader, summary

#: Seconds between the last advertisement and the log's start, for subscribers to find the topics.
LEAD = 1.0

# No single sleep is longer: a wild timestamp must not overflow the sleeper, and progress goes on.
_NAP = 0.25
_PROGRESS_INTERVAL = 0.1


class Series(msgspec.Struct, frozen=True, eq=False):
    """A topic instance of a log, as the sink advertises it.

    Attributes:
        topic: the log's name for it, mended where no topic may be called so.
        instance: its number in the log.
        type_name: CamelCase name of its message type.
        definition: self-contained .msg text of the type.
        encoded_size: bytes of every payload, header included.
        rows: samples in one pass of the log.
        transcoder: turns rows into payloads.
    """

    topic: str
    instance: int
    type_name: str
    definition: str
    encoded_size: int
    rows: int
    transcoder: Transcoder


class Sink(Protocol):
    """Where a played log goes."""

    def advertise(self, series: Series) -> None:
        """Make the series known under its topic and instance; called once, before all samples."""

    def publish(self, series: Series, payload: bytes) -> None:
        """Publish XCDR1 bytes with their header as they are; a timestamp of 0 stays 0."""


class Sample(NamedTuple):
    """A sample and when it is due.

    Attributes:
        due: seconds after the last advertisement; never less than the sample's before.
        series: what it belongs to.
        payload: XCDR1 bytes with their header.
        timestamp_us: the row's timestamp, on the log's clock.
    """

    due: float
    series: Series
    payload: bytes
    timestamp_us: int


class Progress(NamedTuple):
    """How far the player is: microseconds of the log's duration, and samples over all passes."""

    elapsed_us: int
    duration_us: int
    samples: int


class Played(NamedTuple):
    """What was played: series, samples, and the log's first fault (empty without any)."""

    series: int
    samples: int
    problem: str


SeriesMap = Mapping[tuple[str, int], Series]
"""The series to play, by the log's topic and instance."""


def select(log: Summary, topics: Sequence[str] | None = None) -> dict[tuple[str, int], Series]:
    """Return the series of a log that have samples, in the log's order.

    Args:
        log: what ``summary`` returned.
        topics: glob patterns; None for all topics.

    Raises:
        LogError: a format has no usable layout.
    """
    transcoders: dict[str, Transcoder] = {}
    chosen = {}
    for entry in log.series:
        if not entry.rows or not _wanted(entry.topic, topics):
            continue
        coder = transcoders.get(entry.topic)
        if coder is None:
            coder = transcoders[entry.topic] = Transcoder(entry.topic, log.formats)
        chosen[entry.topic, entry.instance] = Series(
            topic=coder.topic,
            instance=entry.instance,
            type_name=coder.type_name,
            definition=coder.definition,
            encoded_size=coder.encoded_size,
            rows=entry.rows,
            transcoder=coder,
        )
    return chosen


def _wanted(topic: str, patterns: Sequence[str] | None) -> bool:
    return patterns is None or any(fnmatch.fnmatchcase(topic, pattern) for pattern in patterns)


def schedule(
    read: Callable[[], Iterable[Record]],
    series: SeriesMap,
    *,
    start_us: int,
    rate: float = 1.0,
    loop: bool = False,
) -> Iterator[Sample]:
    """Yield the samples of a log in file order, each with the time it is due.

    Args:
        read: begins a pass through the log's records; called once, or again for each loop.
        series: the series to play; other rows are passed over.
        start_us: the log's start, due after ``LEAD``.
        rate: 1 is real time, 2 twice as fast, 0 as fast as possible (all are due after ``LEAD``).
        loop: begin again when the log ends; ends only if a pass has no samples.

    Raises:
        ValueError: a rate that is negative or no finite number.
    """
    _check_rate(rate)
    return _passes(read, series, start_us, rate, loop)


def _check_rate(rate: float) -> None:
    if not math.isfinite(rate) or rate < 0:
        raise ValueError(f"rate = {rate}: it must be 0 or a positive number")


def _passes(
    read: Callable[[], Iterable[Record]], series: SeriesMap, start_us: int, rate: float, loop: bool
) -> Iterator[Sample]:
    begin, again = LEAD, True
    while again:
        # A pass begins where the one before ended; one without samples would spin for ever.
        due, again = begin, False
        for sample in _one_pass(read(), series, start_us, rate, begin):
            due, again = sample.due, loop
            yield sample
        begin = due


def _one_pass(
    records: Iterable[Record], series: SeriesMap, start_us: int, rate: float, begin: float
) -> Iterator[Sample]:
    due = begin
    for record in records:
        if not isinstance(record, Data):
            continue
        target = series.get((record.series.topic, record.series.instance))
        if target is None:
            continue
        if rate:
            due = max(due, begin + (record.timestamp_us - start_us) / 1e6 / rate)
        yield Sample(due, target, target.transcoder.encode(record.row), record.timestamp_us)


def play(
    path: str | os.PathLike[str],
    sink: Sink,
    *,
    rate: float = 1.0,
    loop: bool = False,
    topics: Sequence[str] | None = None,
    clock: Callable[[], float] = time.monotonic,
    sleep: Callable[[float], object] = time.sleep,
    progress: Callable[[Progress], object] | None = None,
) -> Played:
    """Play a log into a sink and return when it ends; with ``loop`` never, but by an exception.

    The log is read through once to advertise every series with samples; then time starts.

    Args:
        path: the ULog file.
        sink: what advertises and publishes.
        rate: 1 is real time, 2 twice as fast, 0 as fast as possible.
        loop: begin again when the log ends.
        topics: glob patterns of the topics to play; None for all.
        clock: seconds, monotonic.
        sleep: waits for so many seconds; an exception it raises ends the playing.
        progress: called ten times a second while samples flow, and at the end.

    Raises:
        LogError: the file is no ULog, or needs a newer reader.
        OSError: the file cannot be read.
        ValueError: a rate that is negative or no finite number.
    """
    _check_rate(rate)
    log = summary(path)
    series = select(log, topics)
    samples = schedule(partial(_records, path), series, start_us=log.start_us, rate=rate, loop=loop)
    for entry in series.values():
        sink.advertise(entry)
    count = _run(samples, sink, log, clock, sleep, progress)
    return Played(len(series), count, log.problem)


def _records(path: str | os.PathLike[str]) -> Iterator[Record]:
    with ULogReader(path) as log:
        yield from log


def _run(
    samples: Iterable[Sample],
    sink: Sink,
    log: Summary,
    clock: Callable[[], float],
    sleep: Callable[[float], object],
    progress: Callable[[Progress], object] | None,
) -> int:
    start = now = clock()
    count, report_at, duration = 0, now, log.duration_us()
    for sample in samples:
        while (wait := start + sample.due - (now := clock())) > 0:
            sleep(min(wait, _NAP))
        sink.publish(sample.series, sample.payload)
        count += 1
        if progress is not None and now >= report_at:
            progress(Progress(min(max(sample.timestamp_us - log.start_us, 0), duration), duration, count))
            report_at = now + _PROGRESS_INTERVAL
    if progress is not None:
        progress(Progress(duration, duration, count))
    return count
