"""The verb `uorb demo`: its arguments, its course from start to summary, and every way it may end."""

import argparse
import os
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from math import inf
from time import monotonic
from types import FrameType

from ..errors import UorbError
from ..logs.ulog import ULogReader
from .crew import Crew
from .reports import AUTOPILOT, COMPANION, QUIET
from .screen import Screen, frame, missing, summary

START_WAIT = 15.0  # seconds until something must have come through
SETTLE_WAIT = 1.5  # seconds for what is on its way at the end
FRAME_EVERY = 1.0
PATIENCE = 0.3  # seconds a picture waits for a report that is about to come
COMPANY = 0.1  # seconds between the first host's report and a picture of both
EXAMPLE = """examples:
  uorb demo                       fly until Ctrl-C
  uorb demo --seconds 10          fly 10 s, then tell what was sent, received and lost
  uorb demo --log FLIGHT.ulg      play a flight through the autopilot instead
"""


def add(parser: argparse.ArgumentParser) -> None:
    """Give a parser this verb's arguments."""
    parser.description = "Show a vehicle of two hosts on this machine: an autopilot in flight and a companion."
    parser.epilog = EXAMPLE
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.add_argument("--seconds", type=_seconds, metavar="N", help="end by itself after N seconds")
    parser.add_argument("--log", metavar="FILE.ulg", help="play a flight instead of the simulation")
    parser.add_argument("--seed", type=int, default=1, metavar="N", help="of wind and noise (default: 1)")


def _seconds(text: str) -> float:
    try:
        seconds = float(text)
    except ValueError:
        seconds = 0.0
    if not 0.0 < seconds < 1e9:
        raise argparse.ArgumentTypeError(f"{text!r} is not a number of seconds above 0")
    return seconds


def run(args: argparse.Namespace) -> int:
    """Run the demo and return its exit status.

    Raises:
        UorbError, OSError: it cannot be shown; the text says why in one line.
        BrokenPipeError: nobody reads what it shows.
    """
    if not args.log:
        return Demo(f"simulated flight, seed {args.seed}", args.seconds, seed=args.seed, log="").run()
    log = os.path.abspath(args.log)
    ULogReader(log).close()  # a wrong file is told before anything is started
    name = "".join(c if c.isprintable() else "?" for c in os.path.basename(log))
    return Demo(f"{name}, played", args.seconds, seed=args.seed, log=log).run()


class _Signal(BaseException):
    """A signal that ends the demo, with its exit status."""

    def __init__(self, status: int) -> None:
        self.status = status


class _Signals:
    """Turns signals into `_Signal`, but never while the demo starts or cleans up."""

    STATUS = {signal.SIGINT: 130, signal.SIGTERM: 0, signal.SIGHUP: 129}  # noqa: RUF012 - never changed

    def __init__(self) -> None:
        self._open = False
        self._waiting: int | None = None

    def _handle(self, number: int, stack: FrameType | None) -> None:
        status = self.STATUS[signal.Signals(number)]
        if self._open:
            raise _Signal(status)
        self._waiting = status

    @contextmanager
    def held(self) -> Iterator[None]:
        """Handle signals here; they wait but for inside `welcome`."""
        before = {number: signal.signal(number, self._handle) for number in self.STATUS}
        try:
            yield
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)

    @contextmanager
    def welcome(self) -> Iterator[None]:
        """Raise `_Signal` for what comes, or came before."""
        try:
            self._open = True
            if self._waiting is not None:
                raise _Signal(self._waiting)
            yield
        finally:
            self.shut()

    def shut(self) -> None:
        """Let signals wait from here on."""
        self._open = False


class Demo:
    """One run of the demo."""

    def __init__(self, title: str, seconds: float | None, *, seed: int, log: str) -> None:
        self._title = title
        self._seconds = seconds
        self._signals = _Signals()
        self._screen = Screen()
        self._seed, self._log = seed, log
        self._begin = self._next = 0.0

    def run(self) -> int:
        """Start, show, sum up, clean up; return the exit status. Raises as `run` of this module."""
        with self._signals.held():
            self._crew = Crew(seed=self._seed, log=self._log)
            try:
                return self._course()
            except _Signal as signalled:
                return signalled.status
            finally:
                self._signals.shut()
                self._crew.end()

    def _course(self) -> int:
        status = 0
        try:
            with self._signals.welcome():
                self._show()
        except _Signal as signalled:
            if signalled.status != 130:
                raise
            status = 130  # Ctrl-C: the summary still, and a second one ends that too
        if self._begin:
            with self._signals.welcome():
                self._sum_up()
        return status

    # -- while it runs -----------------------------------------------------------------------------

    def _show(self) -> None:
        """Show pictures until time is up or the log is over."""
        deadline = monotonic() + START_WAIT
        while not self._over(now := monotonic()):
            if not self._begin and now > deadline:
                raise UorbError(f"nothing came from host to host within {START_WAIT:.0f} s")
            self._listen(now)

    def _over(self, now: float) -> bool:
        if not self._begin:
            return False
        autopilot = self._crew.reports.get(AUTOPILOT)
        done = autopilot is not None and autopilot.done
        return done or (self._seconds is not None and now - self._begin >= self._seconds)

    def _listen(self, now: float) -> None:
        """Take reports, and draw soon after the companion's: at once when it is late, or never comes."""
        for report in self._crew.listen(self._due(now) - now):
            if report.host == COMPANION and report.rows:
                self._begin = self._begin or monotonic()
                self._next = min(self._next or inf, monotonic() + COMPANY)
        if self._begin and monotonic() >= self._next:
            self._next = monotonic() + FRAME_EVERY + PATIENCE
            self._draw()

    def _due(self, now: float) -> float:
        """Return when there is something to do, report or not."""
        if not self._begin:
            return now + PATIENCE
        return self._next if self._seconds is None else min(self._next, self._begin + self._seconds)

    def _draw(self) -> None:
        elapsed = monotonic() - self._begin
        self._screen.draw(frame(self._title, elapsed, self._crew.reports, self._crew.folder))

    # -- the end -----------------------------------------------------------------------------------

    def _sum_up(self) -> None:
        """Let both publish no more, wait for what is on its way, and tell the account."""
        elapsed = monotonic() - self._begin
        self._crew.say(QUIET)
        deadline = monotonic() + SETTLE_WAIT
        while (left := deadline - monotonic()) > 0 and not self._settled():
            for _ in self._crew.listen(min(left, 0.1)):
                pass
        self._screen.write(summary(self._title, elapsed, self._crew.reports))

    def _settled(self) -> bool:
        """Whether both hosts are quiet and have told of all that the other one published."""
        reports = self._crew.reports
        if len(reports) < 2 or not all(report.quiet for report in reports.values()):
            return False
        autopilot, companion = reports[AUTOPILOT], reports[COMPANION]
        return missing(autopilot, companion) == 0 == missing(companion, autopilot)
