"""`uorb ls`: every node of the bus."""

import argparse
from collections.abc import Sequence

from ..broker.survey import TopicStatus
from .carried import opened
from .options import Parser, add_common
from .table import Column, table
from .values import dumps

COLUMNS = (
    Column("TOPIC NAME", right=False),
    Column("INST"),
    Column("TYPE", right=False),
    Column("ADV", right=False),
    Column("#PUB"),
    Column("#SUB"),
    Column("#QSIZE"),
    Column("WRITES"),
    Column("LOST"),
    Column("PRIO"),
    Column("ORIGIN", right=False),
)


def add(parser: Parser) -> None:
    """Add the verb's arguments."""
    parser.describe(
        "List every node of the bus: topics that somebody advertises, or subscribes to, or did so.",
        "uorb ls",
        "uorb ls --json --connect tcp/192.168.1.10:7447",
    )
    parser.add_argument("--json", action="store_true", help="one list of objects, with type hashes")
    add_common(parser)


def run(args: argparse.Namespace) -> int:
    """List, and return 1 for an empty bus."""
    with opened(args) as bus:
        bus.settle()
        nodes = bus.broker.topics()
        path = bus.broker.path
    if args.json:
        print(dumps(nodes))
    elif nodes:
        print("\n".join(lines(nodes)))
    else:
        import sys

        print(f"uorb ls: no topics on {path}: nobody has advertised or subscribed yet", file=sys.stderr)
    return 0 if nodes else 1


def lines(nodes: Sequence[TopicStatus]) -> list[str]:
    """Return the table."""
    return table(COLUMNS, [_row(node) for node in nodes])


def _row(node: TopicStatus) -> list[object]:
    return [
        node.topic,
        node.instance,
        node.type,
        "yes" if node.advertised else "no",
        node.publishers,
        node.subscribers,
        node.queue_length,
        node.generation,
        node.lost,
        node.priority,
        node.origin,
    ]
