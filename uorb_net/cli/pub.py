"""`uorb pub TOPIC JSON`: a message from the command line, checked before anything is sent."""

import argparse
import sys
from time import monotonic, sleep
from typing import TYPE_CHECKING, Any

from ..errors import EncodeError
from . import UsageError
from .carried import PEER_WAIT, Bus, opened
from .in_use import type_in_use
from .options import Parser, add_common, count, instance, rate, seconds
from .values import loads, message_from

if TYPE_CHECKING:
    from ..messages import Message
    from ..publication import Publication

HOLD = 1.0
TYPE_WAIT = 2.0  # seconds for a peer of the own link to tell a definition


def add(parser: Parser) -> None:
    """Add the verb's arguments."""
    parser.describe(
        "Publish a message, its fields given as JSON; those left out are 0. NaN is null, an infinity "
        '"inf" or "-inf",\nuint8[N] a list of integers. A timestamp of 0 is stamped.',
        """uorb pub vehicle_attitude '{"q": [1, 0, 0, 0]}'""",
        """uorb pub battery_status '{"voltage_v": 15.2}' -i 1 -r 10 -n 50""",
        """uorb pub offboard_control_mode '{"velocity": true}' --connect tcp/192.168.1.10:7447""",
    )
    parser.add_argument("topic", metavar="TOPIC", help="the topic's name")
    parser.add_argument("json", metavar="JSON", help="the fields, as an object")
    parser.add_argument("-i", "--instance", type=instance, default=0, metavar="N", help="instance 0..9 (0)")
    parser.add_argument("-r", "--rate", type=rate, metavar="HZ", help="publish again and again, until Ctrl-C")
    parser.add_argument(
        "-n", "--count", type=count, metavar="COUNT", help="end after so many, at 1 Hz unless -r is given"
    )
    parser.add_argument(
        "--hold",
        type=seconds,
        default=HOLD,
        metavar="S",
        help="stay advertised so long after the last sample; with an own link, from the first peer on (1)",
    )
    add_common(parser)


def run(args: argparse.Namespace) -> int:
    """Publish; 1 if the own link reached nobody."""
    fields = loads(args.json)
    with opened(args) as bus:
        # Without a link only who is on the bus already can have brought a definition.
        wait = TYPE_WAIT if bus.link else 0.0
        message = _message(type_in_use(bus, args.topic, args.instance, monotonic() + wait), fields)
        with bus.broker.advertise_instance(type(message), args.topic, args.instance) as publication:
            return _publish(args, bus, publication, message)


def _message(cls: "type[Message]", fields: dict[str, Any]) -> "Message":
    try:
        return message_from(cls, fields)
    except EncodeError as error:
        raise UsageError(f"{error}; nothing was published") from error


def _publish(args: argparse.Namespace, bus: Bus, publication: "Publication[Any]", message: "Message") -> int:
    if not args.rate and not args.count:
        publication.publish(message)
    reached = bus.wait_for_peer(max(args.hold, PEER_WAIT))
    if args.rate or args.count:
        _repeat(publication, message, 1.0 / (args.rate or 1.0), args.count)
    if not reached:
        print("uorb pub: published here, but no other host was reached: check the endpoints", file=sys.stderr)
        return 1
    sleep(args.hold)
    return 0


def _repeat(publication: "Publication[Any]", message: "Message", period: float, samples: int | None) -> None:
    """Publish at fixed moments, so that the rate holds however long a publication takes."""
    due, sent = monotonic(), 0
    while samples is None or sent < samples:
        sleep(max(due - monotonic(), 0.0))
        publication.publish(message)
        sent += 1
        due = max(due + period, monotonic() - period)
