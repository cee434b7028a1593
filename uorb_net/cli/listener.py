"""`uorb listener TOPIC`: samples as they come, the one already there first."""

import argparse
import sys
from time import monotonic
from typing import Any

from ..errors import NoDataError
from ..subscription import Sample, Subscription
from .carried import opened
from .in_use import type_in_use
from .options import Parser, add_common, count, instance, rate, seconds
from .values import dumps, plain, text_lines


def add(parser: Parser) -> None:
    """Add the verb's arguments."""
    parser.describe(
        "Print samples of a topic, the one already there first; one unless COUNT or -n says more.",
        "uorb listener sensor_accel",
        "uorb listener sensor_accel 5 -i 1 -r 2",
        "uorb listener vehicle_attitude -n 100 --json --connect tcp/192.168.1.10:7447",
    )
    parser.add_argument("topic", metavar="TOPIC", help="the topic's name")
    parser.add_argument("samples", metavar="COUNT", nargs="?", type=count, help="how many samples")
    parser.add_argument("-n", "--count", type=count, metavar="COUNT", help="how many samples (1)")
    parser.add_argument("-i", "--instance", type=instance, default=0, metavar="N", help="instance 0..9 (0)")
    parser.add_argument("-r", "--rate", type=rate, metavar="HZ", help="at most so many a second")
    parser.add_argument(
        "--timeout",
        type=seconds,
        default=2.0,
        metavar="S",
        help="give up after so many seconds without a sample, waiting for the topic included (2)",
    )
    parser.add_argument("--json", action="store_true", help="one JSON object a line")
    add_common(parser)


def run(args: argparse.Namespace) -> int:
    """Print the samples asked for; 1 if they do not come."""
    wanted = args.count or args.samples or 1
    interval = 1.0 / args.rate if args.rate else 0.0
    with opened(args) as bus:
        deadline = monotonic() + args.timeout
        type_in_use(bus, args.topic, args.instance, deadline)
        topic: tuple[str, int] = args.topic, args.instance
        with bus.broker.subscribe(*topic, interval=interval, definition="publisher") as subscription:
            for number in range(1, wanted + 1):
                sample = _next(subscription, deadline)
                if sample is None:
                    known = number > 1 or bus.broker.advertised(*topic)
                    return _give_up(known, args.timeout)
                _show(subscription, sample, number, as_json=args.json)
                deadline = monotonic() + args.timeout + interval
    return 0


def _next(subscription: Subscription[Any], deadline: float) -> Sample[Any] | None:
    """Return the next sample; None if it has not come by the deadline."""
    while subscription.wait(deadline - monotonic()):
        try:
            return subscription.copy_with_info()
        except NoDataError:
            pass  # unadvertised between the two calls
    return None


def _give_up(known: bool, timeout: float) -> int:
    text = f"Waited for {timeout:.1f} seconds without a message. Giving up." if known else "never published"
    print(text, file=sys.stderr)
    return 1


def _show(subscription: Subscription[Any], sample: Sample[Any], number: int, *, as_json: bool) -> None:
    block = _json(subscription, sample) if as_json else _text(subscription, sample, number)
    print(block, flush=True)


def _json(subscription: Subscription[Any], sample: Sample[Any]) -> str:
    return dumps(
        {
            "topic": subscription.topic,
            "instance": subscription.instance,
            "origin": sample.info.origin,
            "generation": sample.info.generation,
            "published_us": sample.info.published_us,
            "message": plain(sample.message),
        }
    )


def _text(subscription: Subscription[Any], sample: Sample[Any], number: int) -> str:
    which = f" instance {subscription.instance}" if subscription.instance else ""
    head = f"TOPIC: {subscription.topic}{which} #{number}"
    return "\n".join([*([""] if number > 1 else []), head, *text_lines(sample.message)])
