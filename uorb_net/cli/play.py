"""`uorb play FILE`: a ULog onto the bus, with the log's own definitions and instance numbers."""

import argparse
import sys
from time import monotonic, sleep

from ..errors import UorbError
from ..logs.player import Played, Progress, Series, play
from ..logs.sink import BusSink
from . import complain
from .carried import opened
from .options import Parser, add_common, speed
from .values import dumps

TAIL = 1.0  # seconds the topics stay advertised after the last sample, for readers to empty their queues
_NAME = "uorb play"


def add(parser: Parser) -> None:
    """Add the verb's arguments."""
    parser.describe(
        "Play a ULog file onto the bus. All topics are advertised first, samples start 1 s later.",
        "uorb play flight.ulg",
        "uorb play flight.ulg --rate 0 --topics 'sensor_*' vehicle_attitude",
        "uorb play flight.ulg --loop --listen tcp/0.0.0.0:7447",
    )
    parser.add_argument("file", metavar="FILE", help="the log")
    parser.add_argument(
        "-r", "--rate", type=speed, default=1.0, help="1 is real time, 2 twice as fast, 0 as fast as possible"
    )
    parser.add_argument("--loop", action="store_true", help="begin again when the log ends")
    parser.add_argument(
        "--topics", metavar="PATTERN", nargs="+", action="extend", help="only topics that match, with * and ?"
    )
    parser.add_argument("--json", action="store_true", help="the summary as a JSON object")
    add_common(parser)


def run(args: argparse.Namespace) -> int:
    """Play, and return 1 if not all that was asked for could be played."""
    with opened(args) as bus:
        if not bus.wait_for_peer():
            complain(_NAME, "no other host was reached yet; playing for this one")
        refused: list[Series] = []
        sink = BusSink(bus.broker, lambda series, error: _refuse(refused, series, error))
        line = ProgressLine(args.rate)
        began = monotonic()
        try:
            played = play(
                args.file,
                sink,
                rate=args.rate,
                loop=args.loop,
                topics=args.topics,
                progress=line.show if line.terminal else None,
            )
        finally:
            line.end()
        seconds = monotonic() - began
        if sink.rows:
            sleep(TAIL)
    return _report(args, sink, played, seconds, bool(refused))


def _report(args: argparse.Namespace, sink: BusSink, played: Played, seconds: float, refused: bool) -> int:
    if not played.series:
        what = f"no topic with samples matches {' '.join(args.topics)}" if args.topics else "no samples"
        return complain(_NAME, f"{args.file}: {what}{f'; {played.problem}' if played.problem else ''}")
    if args.json:
        summary = {
            "file": args.file,
            "series": sink.playing,
            "rows": sink.rows,
            "seconds": round(seconds, 3),
            "problem": played.problem or None,
        }
        print(dumps(summary))
    else:
        print(f"played {sink.rows} rows of {sink.playing} series in {seconds:.1f} s")
    if played.problem:
        return complain(_NAME, f"{args.file} is damaged: {played.problem}; what is whole was played")
    return int(refused)


def _refuse(refused: list[Series], series: Series, error: UorbError) -> None:
    refused.append(series)
    name = f"{series.topic} instance {series.instance}" if series.instance else series.topic
    complain(_NAME, f"{name} is not played: {error}")


class ProgressLine:
    """One line on standard error, drawn again in place; nothing where that is no terminal."""

    def __init__(self, rate: float) -> None:
        self.terminal = sys.stderr is not None and sys.stderr.isatty()
        self._rate = f"rate {rate:g}" if rate else "as fast as possible"
        self._drawn = False

    def show(self, progress: Progress) -> None:
        """Draw how far the player is."""
        sys.stderr.write(f"\r{self.text(progress)}\x1b[K")
        sys.stderr.flush()
        self._drawn = True

    def text(self, progress: Progress) -> str:
        """Return the line."""
        share = progress.elapsed_us / progress.duration_us if progress.duration_us else 1.0
        times = f"{progress.elapsed_us / 1e6:.1f} of {progress.duration_us / 1e6:.1f} s"
        return f"{share:4.0%}  {times}, {self._rate}, {progress.samples} rows"

    def end(self) -> None:
        """Leave the line."""
        if self._drawn:
            sys.stderr.write("\n")
