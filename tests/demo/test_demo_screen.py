"""What the demo shows: columns that stay in their places, an account that balances."""

import io
import os
import pty
from collections.abc import Callable, Iterator
from typing import Any

import msgspec
import pytest

from uorb_net.demo.reports import Attitude, Report, Row
from uorb_net.demo.screen import WIDTH, Screen, frame, missing, summary
from uorb_net.link import LinkStats, PeerStatus

NUMBERS = dict.fromkeys(LinkStats.__struct_fields__[3:], 0)
LINK = LinkStats(host="companion", vehicle="default", state="up", **NUMBERS)


def row(**changes: Any) -> Row:
    """Return a row of a topic."""
    plain = Row("sensor_combined", 0, "autopilot", 200.2, 590, 1, 2, 7, 0.0042, 0.0006)
    return msgspec.structs.replace(plain, **changes)


def reports(*rows: Row, published: int = 600) -> dict[str, Report]:
    """Return both hosts' reports, the companion's with rows."""
    peer = PeerStatus(host="autopilot", state="up", since_us=1, round_trip=0.00052)
    attitude = Attitude((10.0, -2.0, 179.0), (10.5, -2.0, -179.0), 1.0, 2.5, 500)
    return {
        "autopilot": Report("autopilot", published, [], [], None, 0.09, endpoint="tcp/127.0.0.1:1"),
        "companion": Report("companion", 0, list(rows), [peer], LINK, 0.1, attitude=attitude),
    }


def test_reports_cross_as_json() -> None:
    """What the processes send is what the parent gets."""
    for report in reports(row(), row(age=None, latency=None)).values():
        assert msgspec.json.decode(msgspec.json.encode(report), type=Report) == report


def test_a_frame() -> None:
    """Hosts, attitudes with the difference the short way round, and topics, none wider than the screen."""
    lines = frame("a title", 12.3, reports(row()), "/dev/shm/uorb-demo-x")
    assert max(map(len, lines)) <= WIDTH
    assert lines[0].startswith("uorb demo: a title")
    assert lines[0].endswith("12 s")
    assert "companion   autopilot   up             0.52 ms" in "\n".join(lines)
    assert next(line for line in lines if line.startswith("difference")).split()[1:] == ["0.5", "0.0", "2.0"]
    assert lines[-1].split() == ["sensor_combined", "0", "200", "1", "2", "4.20", "ms", "autopilot"]


def test_columns_hold_long_names_and_large_numbers() -> None:
    """Every row is as wide as its head, and within the screen."""
    large = row(topic="a_topic_name_longer_than_any_that_px4_has", rate=99999.0, lost=1234567, net_lost=12345678)
    old = row(age=86400.0, origin="a_host_with_a_long_name", rate=0.25)
    lines = frame("x" * 300, 1e6, reports(large, old), "/dev/shm/uorb-demo-x")
    assert max(map(len, lines)) <= WIDTH
    head, *table = lines[-3:]
    at = head.index("  ORIGIN")
    assert [line[at : at + 4] for line in table] == ["  au", "  a_"]


def test_the_account_balances() -> None:
    """Published is received, lost on either side, and early."""
    told = reports(row())
    assert missing(told["autopilot"], told["companion"]) == 0
    lines = summary("a title", 3.0, told)
    assert max(map(len, lines)) <= WIDTH
    assert lines[3].split() == ["autopilot", "600", "companion", "590", "7", "1", "2", "0", "0.60", "ms"]
    assert lines[-1] == "published = samples + early + lost + netlost, on both hosts"


def test_an_open_account_is_told() -> None:
    """Samples nobody can account for are named, not hidden."""
    told = reports(row(), published=605)
    assert missing(told["autopilot"], told["companion"]) == 5
    assert summary("a title", 3.0, told)[-1].startswith("5 samples are not accounted for")


def test_clocks_that_cannot_be_compared_show_nothing() -> None:
    """Rather than nonsense."""
    lines = frame("a title", 1.0, reports(row(age=None)), "/dev/shm/uorb-demo-x")
    assert lines[-1].split()[-2:] == ["-", "autopilot"]


def test_one_host_may_be_missing() -> None:
    """As in the first moment: nothing fails."""
    only = {"companion": reports(row())["companion"]}
    assert frame("a title", 0.0, only, "/x")
    assert summary("a title", 0.0, only)


def test_into_a_pipe() -> None:
    """Plain blocks, one below the other."""
    stream = io.StringIO()
    screen = Screen(stream)
    screen.draw(["one"])
    screen.draw(["two"])
    assert stream.getvalue() == "one\n\ntwo\n\n"


@pytest.fixture
def terminal() -> Iterator[tuple[Screen, Callable[[], str]]]:
    """A screen on a terminal of 24 rows and 40 columns, and what the terminal got."""
    ours, theirs = pty.openpty()
    os.set_blocking(ours, False)
    import fcntl
    import struct
    import termios

    fcntl.ioctl(theirs, termios.TIOCSWINSZ, struct.pack("HHHH", 24, 40, 0, 0))
    with open(theirs, "w", encoding="ascii") as stream:
        yield Screen(stream), lambda: os.read(ours, 1 << 16).decode().replace("\r", "")
    os.close(ours)


def test_on_a_terminal(terminal: tuple[Screen, Callable[[], str]]) -> None:
    """Each picture in the place of the one before, line by line over it, cut to the window."""
    screen, shown = terminal
    screen.draw(["one", "x" * 50])
    assert shown() == f"\x1b[2J\x1b[Hone\x1b[K\n{'x' * 40}\x1b[K\n\x1b[J"
    screen.draw(["two"])
    assert shown() == "\x1b[Htwo\x1b[K\n\x1b[J"
    screen.draw([f"line {number}" for number in range(30)])
    lines = shown().split("\n")
    assert len(lines) == 24
    assert lines[-2] == "... 8 more lines: make the window taller\x1b[K"
