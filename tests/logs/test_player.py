"""The player's pacing on a clock of the test's own."""

import itertools
import math
import struct
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from uorb_net.logs.player import LEAD, Played, Progress, Sample, Series, play, schedule, select
from uorb_net.logs.ulog import LogError, Record, ULogReader, summary

MakeLog = Callable[..., bytes]
START = 1_000_000
PAIR = ("F", "pair:uint64_t timestamp;float x;uint8_t[4] _padding0;")
OTHER = ("F", "other_topic:uint64_t timestamp;int32_t n;")


def row(timestamp_us: int) -> bytes:
    """Return a row of either format."""
    return struct.pack("<Qi", timestamp_us, 1)


class StopPlaying(Exception):  # noqa: N818 - a signal, not an error
    """Ends a play that would go on."""


class Recorder:
    """A sink, a clock and a sleep in one: time moves only by sleeping, and by ``cost`` a publish."""

    def __init__(self, cost: float = 0.0) -> None:
        self.now = 100.0
        self.cost = cost
        self.advertised: list[tuple[str, int, str]] = []
        self.published: list[tuple[float, str, int, int]] = []
        self.payloads: list[bytes] = []
        self.naps: list[float] = []

    def advertise(self, series: Series) -> None:
        """Note the series; all must come before the first sample."""
        assert not self.published
        self.advertised.append((series.topic, series.instance, series.type_name))

    def publish(self, series: Series, payload: bytes) -> None:
        """Note when, since the start, and what."""
        (timestamp_us,) = struct.unpack_from("<Q", payload, 4)
        self.published.append((round(self.now - 100.0, 6), series.topic, series.instance, timestamp_us))
        self.payloads.append(payload)
        self.now += self.cost

    def clock(self) -> float:
        """Return the time."""
        return self.now

    def sleep(self, seconds: float) -> None:
        """Let time pass."""
        assert seconds > 0
        self.naps.append(seconds)
        self.now += seconds

    def play(self, path: Path, **options: Any) -> Played:
        """Play a log into this recorder."""
        return play(path, self, clock=self.clock, sleep=self.sleep, **options)


@pytest.fixture
def log(tmp_path: Path, make_log: MakeLog) -> Path:
    """A log of three series: instance 2 without lower ones, old samples, one subscription late."""
    path = tmp_path / "log.ulg"
    path.write_bytes(
        make_log(
            PAIR,
            OTHER,
            ("A", 2, 7, "pair"),
            ("A", 0, 9, "other_topic"),
            ("A", 5, 3, "other_topic"),
            ("D", 7, row(START + 500_000)),
            ("D", 9, row(0)),
            ("D", 7, row(START - 400_000)),
            ("D", 9, row(START + 2_000_000)),
            ("A", 1, 8, "other_topic"),
            ("D", 8, row(START + 1_500_000)),
            ("D", 7, row(START + 3_000_000)),
            start_us=START,
        )
    )
    return path


def test_real_time(log: Path) -> None:
    """A sample is due a second plus its age in the log; older ones go at once, in file order."""
    sink = Recorder()
    assert sink.play(log) == Played(3, 6, "")
    assert sink.published == [
        (LEAD + 0.5, "pair", 2, START + 500_000),
        (LEAD + 0.5, "other_topic", 0, 0),
        (LEAD + 0.5, "pair", 2, START - 400_000),
        (LEAD + 2.0, "other_topic", 0, START + 2_000_000),
        (LEAD + 2.0, "other_topic", 1, START + 1_500_000),
        (LEAD + 3.0, "pair", 2, START + 3_000_000),
    ]


def test_all_series_with_samples_are_advertised_first(log: Path) -> None:
    """Under the log's instance numbers; a series that never gets a sample is left out."""
    sink = Recorder()
    sink.play(log, rate=0)
    assert sink.advertised == [
        ("pair", 2, "Pair"),
        ("other_topic", 0, "OtherTopic"),
        ("other_topic", 1, "OtherTopic"),
    ]


def test_payloads_are_encoded_messages(log: Path) -> None:
    """Header, then the row without its padding; the timestamp is the log's, 0 stays 0."""
    sink = Recorder()
    sink.play(log, rate=0)
    assert sink.payloads[1] == b"\x00\x01\x00\x00" + row(0)
    assert all(len(payload) == 16 for payload in sink.payloads)


@pytest.mark.parametrize(("rate", "last"), [(1, 3.0), (2, 1.5), (0.5, 6.0), (10, 0.3)])
def test_rate_divides_the_log_s_time(log: Path, rate: float, last: float) -> None:
    """The second before the first sample stays a second at any rate."""
    sink = Recorder()
    sink.play(log, rate=rate)
    assert sink.published[-1][0] == pytest.approx(LEAD + last)


def test_rate_zero_sends_all_at_once(log: Path) -> None:
    """As fast as possible, after the second for the subscribers."""
    sink = Recorder()
    sink.play(log, rate=0)
    assert {due for due, *_ in sink.published} == {LEAD}
    assert len(sink.published) == 6


@pytest.mark.parametrize("rate", [-1, -0.1, math.nan, math.inf])
def test_a_rate_that_is_none_is_refused(log: Path, rate: float) -> None:
    """Before anything is advertised."""
    sink = Recorder()
    with pytest.raises(ValueError, match="rate"):
        sink.play(log, rate=rate)
    assert not sink.advertised
    with pytest.raises(ValueError, match="rate"):
        schedule(list, {}, start_us=0, rate=rate)


@pytest.mark.parametrize(
    ("topics", "expected"),
    [
        (["pair"], {"pair"}),
        (["o*", "x"], {"other_topic"}),
        (["*"], {"pair", "other_topic"}),
        (["PAIR"], set()),
        ([], set()),
    ],
)
def test_topics_are_chosen_by_pattern(log: Path, topics: list[str], expected: set[str]) -> None:
    """What no pattern names is neither advertised nor published, and the times stay."""
    sink = Recorder()
    sink.play(log, topics=topics)
    assert {topic for topic, *_ in sink.advertised} == expected
    assert {topic for _, topic, *_ in sink.published} == expected


def test_a_slow_sink_catches_up(log: Path) -> None:
    """Lateness does not add up: what is overdue goes at once."""
    sink = Recorder(cost=0.7)
    sink.play(log)
    assert [when for when, *_ in sink.published] == pytest.approx([1.5, 2.2, 2.9, 3.6, 4.3, 5.0])


def test_loop_begins_again_where_the_log_ended(log: Path) -> None:
    """The second pass has no second of waiting, and nothing is advertised again."""
    sink = Recorder()

    def progress(state: Progress) -> None:
        if state.samples >= 12:
            raise StopPlaying

    with pytest.raises(StopPlaying):
        sink.play(log, loop=True, progress=progress)
    assert [when for when, *_ in sink.published[5:8]] == [LEAD + 3.0, LEAD + 3.5, LEAD + 3.5]
    assert sink.published[11][0] == LEAD + 6.0
    assert len(sink.advertised) == 3


def test_loop_of_a_log_without_samples_ends(tmp_path: Path, make_log: MakeLog) -> None:
    """Nothing to play is no reason to spin."""
    path = tmp_path / "empty.ulg"
    path.write_bytes(make_log(PAIR, ("A", 0, 1, "pair")))
    assert Recorder().play(path, loop=True) == Played(0, 0, "")


def test_a_wild_timestamp_is_slept_in_short_naps(tmp_path: Path, make_log: MakeLog) -> None:
    """No sleep is long, so that whoever sleeps can be stopped."""
    path = tmp_path / "wild.ulg"
    path.write_bytes(make_log(PAIR, ("A", 0, 1, "pair"), ("D", 1, row((1 << 64) - 1)), start_us=START))
    sink = Recorder()

    def sleep(seconds: float) -> None:
        sink.sleep(seconds)
        if len(sink.naps) == 100:
            raise StopPlaying

    with pytest.raises(StopPlaying):
        play(path, sink, clock=sink.clock, sleep=sleep)
    assert max(sink.naps) <= 0.25


def test_progress_tells_the_log_s_time(log: Path) -> None:
    """It never leaves the log's duration, and ends at its end."""
    seen: list[Progress] = []
    Recorder().play(log, progress=seen.append)
    assert seen[-1] == Progress(3_000_000, 3_000_000, 6)
    assert [state.elapsed_us for state in seen] == sorted(state.elapsed_us for state in seen)
    assert len(seen) == 4


def test_a_cut_log_plays_to_the_cut_and_says_so(log: Path) -> None:
    """Whole samples are played; the result names the fault."""
    log.write_bytes(log.read_bytes()[:-4])
    sink = Recorder()
    played = sink.play(log, rate=0)
    assert (played.samples, len(sink.published)) == (5, 5)
    assert "ends inside a message" in played.problem


def test_other_files_are_refused_before_anything(tmp_path: Path) -> None:
    """No ULog, no advertisement."""
    path = tmp_path / "x.ulg"
    path.write_bytes(b"no log")
    sink = Recorder()
    with pytest.raises(LogError):
        sink.play(path)
    assert not sink.advertised


def test_schedule_reads_lazily_and_anew_for_each_pass(log: Path) -> None:
    """One pass through the records for each loop, begun when it is needed."""
    whole = summary(log)
    passes = itertools.count()

    def read() -> Iterator[Record]:
        next(passes)
        with ULogReader(log) as reader:
            yield from reader

    samples = schedule(read, select(whole), start_us=whole.start_us, loop=True)
    first = list(itertools.islice(samples, 6))
    assert next(passes) == 1
    assert isinstance(first[0], Sample)
    assert next(samples).due == first[-1].due + 0.5
    assert next(passes) == 3
