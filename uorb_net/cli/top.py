"""`uorb top`: rates, losses and readers of every node, from two looks a second apart."""

import argparse
import fnmatch
from collections.abc import Mapping, Sequence
from time import monotonic
from typing import Any

import msgspec

from ..broker.survey import Survey
from ..clock import hrt_absolute_time
from .carried import Bus, opened
from .options import Parser, add_common
from .screen import Screen
from .table import Column, table
from .values import dumps

PERIOD = 1.0
COLUMNS = (
    Column("TOPIC NAME", right=False),
    Column("INST"),
    Column("#SUB"),
    Column("#MSG"),
    Column("#LOST"),
    Column("#QSIZE", right=False),
    Column("SIZE"),
    Column("ORIGIN", right=False),
    Column("AGE"),
    Column("NETLOST"),
)

Key = tuple[str, int]


class Look(msgspec.Struct, frozen=True):
    """All nodes at one moment: seconds, and surveys by topic and instance."""

    at: float
    nodes: Mapping[Key, Survey]


class Row(msgspec.Struct, frozen=True, kw_only=True):
    """A node over one period. `age`: seconds since the last write, None for never; `lost`: totals."""

    name: str
    instance: int
    subscribers: int
    rate_hz: float
    lost: int
    queue_length: int
    size: int
    origin: str
    age: float | None
    link_lost: int


class Losses(msgspec.Struct, frozen=True):
    """What a node lost per second in the period: its readers, and the network before them."""

    lost_hz: float
    link_lost_hz: float


def add(parser: Parser) -> None:
    """Add the verb's arguments."""
    parser.describe(
        "Show the topics published in the last second, once a second; q or Ctrl-C ends.",
        "uorb top",
        "uorb top -a sensor 'vehicle_*'",
        "uorb top --once --json",
    )
    parser.add_argument(
        "filters", metavar="FILTER", nargs="*", help="show topics whose name holds this, or matches with * ?"
    )
    parser.add_argument("-a", "--all", action="store_true", help="show topics that are not published too")
    parser.add_argument("--once", action="store_true", help="show one period and end")
    parser.add_argument("--json", action="store_true", help="one list of objects a period, with every node")
    add_common(parser)


def run(args: argparse.Namespace) -> int:
    """Show until told to end; 1 if there was no node."""
    with opened(args) as bus:
        if args.once:
            bus.settle()
        with Screen() as screen:
            return _watch(args, bus, screen)


def _watch(args: argparse.Namespace, bus: Bus, screen: Screen) -> int:
    before = look(bus, args.filters)
    while True:
        ended = screen.wait(PERIOD - (monotonic() - before.at))
        now = look(bus, args.filters)
        if args.json:
            print(dumps([row for row, _ in compare(before, now)]), flush=True)
        elif not ended:
            screen.draw(lines(compare(before, now), everything=args.all or bool(args.filters)))
        if ended or args.once:
            return 0 if now.nodes else 1
        before = now


def look(bus: Bus, filters: Sequence[str] = ()) -> Look:
    """Look at the nodes whose topics the filters want."""
    nodes = {
        (node.status.topic, node.status.instance): node
        for node in bus.broker.survey()
        if wanted(node.status.topic, filters)
    }
    return Look(monotonic(), nodes)


def wanted(topic: str, filters: Sequence[str]) -> bool:
    """Tell whether a name holds, or as a pattern matches, one of the filters; without any it does."""
    return not filters or any(text in topic or fnmatch.fnmatchcase(topic, text) for text in filters)


def compare(before: Look, now: Look) -> list[tuple[Row, Losses]]:
    """Return a row for each node, by topic and instance."""
    seconds = max(now.at - before.at, 1e-6)
    moment = hrt_absolute_time()
    found = []
    for key, node in now.nodes.items():
        status = node.status
        old = before.nodes.get(key)
        # A node made anew counts from 0 again.
        fresh = old is None or old.status.generation > status.generation
        writes = status.generation - (0 if old is None or fresh else old.status.generation)
        lost = status.lost - (0 if old is None or fresh else old.status.lost)
        row = Row(
            name=status.topic,
            instance=status.instance,
            subscribers=status.subscribers,
            rate_hz=round(writes / seconds, 3),
            lost=status.lost,
            queue_length=status.queue_length,
            size=node.size,
            origin=status.origin,
            age=max(moment - node.received_us, 0) / 1e6 if node.received_us else None,
            link_lost=node.link_lost,
        )
        link_losses = node.link_lost - (0 if old is None or fresh else old.link_lost)
        found.append((row, Losses(max(lost, 0) / seconds, link_losses / seconds)))
    return found


def lines(rows: Sequence[tuple[Row, Losses]], *, everything: bool) -> list[str]:
    """Return the header and the table: `everything`, or what was published in the period."""
    shown = [_cells(row, losses) for row, losses in rows if everything or row.rate_hz]
    return [f"update: {PERIOD:.0f}s, num topics: {len(rows)}", *table(COLUMNS, shown)]


def _cells(row: Row, losses: Losses) -> list[Any]:
    return [
        row.name,
        row.instance,
        row.subscribers,
        round(row.rate_hz),
        round(losses.lost_hz),
        row.queue_length,
        row.size,
        row.origin,
        age_text(row.age),
        round(losses.link_lost_hz),
    ]


def age_text(seconds: float | None) -> str:
    """Return a duration in the unit that suits it; `-` for never."""
    if seconds is None:
        return "-"
    if seconds < 10:
        return f"{seconds:.2f}s"
    return f"{seconds:.0f}s" if seconds < 600 else f"{seconds / 60:.0f}m"
