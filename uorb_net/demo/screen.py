"""What the demo shows: text from reports (pure), and how it reaches a terminal or a pipe."""

import os
import sys
from io import StringIO
from typing import TextIO

from .reports import AUTOPILOT, COMPANION, Attitude, Report, Row

WIDTH = 100
_HOME, _LINE_END, _BELOW = "\x1b[H", "\x1b[K", "\x1b[J"
_CLEAR = "\x1b[2J"


def frame(title: str, elapsed: float, reports: dict[str, Report], folder: str) -> list[str]:
    """Return the lines of one picture; the longest has 100 columns."""
    lines = [f"uorb demo: {title}"[: WIDTH - 12].ljust(WIDTH - 12) + f"{elapsed:10.0f} s"]
    lines += [f"look closer: UORB_RUNTIME_DIR={os.path.join(folder, COMPANION)} uorb top", ""]
    lines += [_HOST_HEAD, *(_host(report) for _, report in sorted(reports.items()))]
    companion = reports.get(COMPANION)
    if companion is not None and companion.attitude is not None:
        lines += ["", *_attitude(companion.attitude)]
    for name in (COMPANION, AUTOPILOT):
        report = reports.get(name)
        if report is not None and report.rows:
            lines += ["", *table(name, report.rows)]
    lines += [f"{report.host}: {report.event}"[:WIDTH] for report in reports.values() if report.event]
    return lines


_HOST_HEAD = (
    f"{'HOST':<12}{'PEER':<12}{'LINK':<11}{'ROUND TRIP':>11}{'SENT':>11}{'RECEIVED':>11}{'LOST':>8}"
    f"{'AGAIN':>8}{'CPU':>8}"
)


def _host(report: Report) -> str:
    peer = report.peers[0] if report.peers else None
    link = report.link
    name, state = (peer.host, peer.state) if peer else ("-", "nobody yet")
    counts = (link.sent_samples, link.received_samples, link.lost, link.retransmitted) if link else (0, 0, 0, 0)
    return (
        f"{report.host:<12}{name:<12}{state:<11}{_time(peer.round_trip if peer else None):>11}"
        f"{counts[0]:>11}{counts[1]:>11}{counts[2]:>8}{counts[3]:>8}{report.cpu:>8.0%}"
    )


def _attitude(attitude: Attitude) -> list[str]:
    """Lay the estimate beside the vehicle's attitude; angles are compared the short way round."""
    gaps = [(own - there + 180.0) % 360.0 - 180.0 for own, there in zip(attitude.own, attitude.vehicle)]
    rows = (
        ("vehicle_attitude", attitude.vehicle),
        ("companion's estimate", attitude.own),
        ("difference", gaps),
    )
    head = f"{'ATTITUDE (deg)':<24}{'ROLL':>9}{'PITCH':>9}{'YAW':>9}"
    return [head, *(f"{name:<24}" + "".join(f"{angle:>9.1f}" for angle in row) for name, row in rows)]


def table(host: str, rows: list[Row]) -> list[str]:
    """Return the table of what a host receives."""
    title = f"RECEIVED AT {host.upper()}"
    head = f"{title:<36}{'INST':>5}{'RATE':>8}{'LOST':>8}{'NETLOST':>9}{'AGE':>11}  ORIGIN"
    return [head, *(_row(row) for row in rows)]


def _row(row: Row) -> str:
    topic = row.topic if len(row.topic) < 36 else row.topic[:33] + "..."
    return (
        f"{topic:<36}{row.instance:>5}{_rate(row.rate):>8}{row.lost:>8}{row.net_lost:>9}"
        f"{_time(row.age):>11}  {row.origin[:18]}"
    )


def _rate(hz: float) -> str:
    return f"{hz:.0f}" if hz >= 9.95 else f"{hz:.1f}"


def _time(seconds: float | None) -> str:
    """Return a duration in the unit that suits it."""
    if seconds is None:
        return "-"
    if abs(seconds) < 1.0:
        return f"{seconds * 1e3:.2f} ms" if abs(seconds) < 0.01 else f"{seconds * 1e3:.0f} ms"
    return f"{seconds:.1f} s"


# -- the summary -----------------------------------------------------------------------------------


def summary(title: str, elapsed: float, reports: dict[str, Report]) -> list[str]:
    """Return the account of the whole run."""
    lines = [f"summary: {title}, {elapsed:.1f} s", "", _SUMMARY_HEAD]
    for sender, receiver in ((AUTOPILOT, COMPANION), (COMPANION, AUTOPILOT)):
        if sender in reports and receiver in reports:
            lines.append(_account(reports[sender], reports[receiver]))
    companion = reports.get(COMPANION)
    if companion is not None and companion.attitude is not None and companion.attitude.count:
        attitude = companion.attitude
        lines += [
            "",
            f"attitude: the companion's estimate was off by {attitude.mean:.1f} deg on average and "
            f"{attitude.worst:.1f} deg at most, of {attitude.count} samples",
        ]
    lines += [f"{r.host}: {r.problem}"[:WIDTH] for r in reports.values() if r.problem]
    return [*lines, "", *_verdict(reports)]


_SUMMARY_HEAD = (
    f"{'HOST':<12}{'PUBLISHED':>10}  {'RECEIVED AT':<12}{'SAMPLES':>9}{'EARLY':>7}{'LOST':>7}{'NETLOST':>9}"
    f"{'RECOVERED':>11}{'LATENCY':>11}"
)


def _account(sender: Report, receiver: Report) -> str:
    rows = [row for row in receiver.rows if row.origin == sender.host]
    recovered = receiver.link.retransmitted if receiver.link else 0
    return (
        f"{sender.host:<12}{sender.published:>10}  {receiver.host:<12}"
        f"{sum(row.received for row in rows):>9}{sum(row.early for row in rows):>7}"
        f"{sum(row.lost for row in rows):>7}{sum(row.net_lost for row in rows):>9}{recovered:>11}"
        f"{_time(_latency(rows)):>11}"
    )


def _latency(rows: list[Row]) -> float | None:
    timed = [(row.latency, row.received) for row in rows if row.latency is not None]
    count = sum(received for _, received in timed)
    return sum(latency * received for latency, received in timed) / count if count else None


def missing(sender: Report, receiver: Report) -> int:
    """Return how many samples of one host the other one's account leaves open."""
    rows = [row for row in receiver.rows if row.origin == sender.host]
    return sender.published - sum(row.received + row.lost + row.net_lost + row.early for row in rows)


def _verdict(reports: dict[str, Report]) -> list[str]:
    if len(reports) < 2:
        return []
    autopilot, companion = reports[AUTOPILOT], reports[COMPANION]
    open_ = abs(missing(autopilot, companion)) + abs(missing(companion, autopilot))
    lines = ["early: published before the other host had subscribed; recovered: asked for again, and came"]
    if open_:
        return [*lines, f"{open_} samples are not accounted for: they were on their way at the end"]
    return [*lines, "published = samples + early + lost + netlost, on both hosts"]


# -- the screen ------------------------------------------------------------------------------------


class Screen:
    """Shows pictures: in place on a terminal, one below the other into a pipe or file."""

    def __init__(self, stream: TextIO | None = None) -> None:
        self._stream = stream or sys.stdout or StringIO()  # None: started with standard output closed
        self._terminal = self._stream.isatty()
        self._drawn = False

    def draw(self, lines: list[str]) -> None:
        """Show a picture in the place of the one before. Raises BrokenPipeError."""
        if not self._terminal:
            self.write([*lines, ""])
            return
        columns, rows = _size(self._stream)
        start = _HOME if self._drawn else _CLEAR + _HOME
        self._drawn = True
        shown = lines if len(lines) < rows else [*lines[: max(rows - 2, 1)], _rest(len(lines) - rows + 2)]
        # One write: what the terminal shows between two of them is the flicker.
        self._write(start + "".join(line[:columns] + _LINE_END + "\n" for line in shown) + _BELOW)

    def write(self, lines: list[str]) -> None:
        """Write lines below what is shown. Raises BrokenPipeError."""
        self._write("".join(line + "\n" for line in lines))

    def _write(self, text: str) -> None:
        if isinstance(self._stream, StringIO):
            self._stream.write(text)
            return
        # Past the stream's buffer: where a reader is slow and a signal ends the wait, nothing is left in it
        # that the interpreter would wait for again at its end.
        data = text.encode(self._stream.encoding or "ascii", "replace")
        while data:
            data = data[os.write(self._stream.fileno(), data) :]


def _size(stream: TextIO) -> os.terminal_size:
    try:
        size = os.get_terminal_size(stream.fileno())
    except (OSError, ValueError):
        return os.terminal_size((WIDTH, 24))
    return size if size.columns and size.lines else os.terminal_size((WIDTH, 24))


def _rest(count: int) -> str:
    return f"... {count} more lines: make the window taller"
