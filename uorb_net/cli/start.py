"""`uorb start`: this host's link to the others, in the foreground, for a terminal or a service manager."""

import argparse
import logging
import time
from collections.abc import Sequence

from ..link import Link
from .carried import make_link, open_broker
from .notify import Notifier
from .options import Parser, add_common
from .settings import settings

NAP = 1.0  # seconds between two looks whether the link lives
LONELY = 3.0  # seconds without any peer before an operator is told
log = logging.getLogger("uorb_net.start")


def add(parser: Parser) -> None:
    """Add the verb's arguments."""
    parser.describe(
        "Join this host's bus with those of other hosts, until Ctrl-C or SIGTERM. Without endpoints it "
        "listens on\ntcp/127.0.0.1:7447.",
        "uorb start --listen tcp/0.0.0.0:7447",
        "uorb start --host companion --connect tcp/192.168.1.10:7447",
        "uorb start --config /etc/uorb.toml",
    )
    add_common(parser)


def run(args: argparse.Namespace) -> int:
    """Run the link until a signal ends it."""
    chosen = settings(args)
    _configure_logging()
    notifier = Notifier()
    with open_broker(chosen.vehicle) as broker, make_link(broker, chosen) as link:
        log.info("%s of vehicle %s %s (bus %s)", link.host, link.vehicle, chosen.endpoints, broker.path)
        try:
            notifier.send("READY=1")
            return _watch(link, notifier, chosen.connect)
        finally:
            log.info("%s is stopping", link.host)
            notifier.send("STOPPING=1")


def _configure_logging() -> None:
    logging.basicConfig(format="%(asctime)s %(levelname)s %(message)s", level=logging.WARNING)
    logging.getLogger("uorb_net").setLevel(logging.INFO)


def _watch(link: Link, notifier: Notifier, connect: Sequence[str]) -> int:
    lonely_at = time.monotonic() + LONELY
    while link.running:
        notifier.feed()
        if connect and time.monotonic() >= lonely_at and not link.peers():
            log.warning("no host reached yet at %s: check address and port; trying on", ", ".join(connect))
            lonely_at = float("inf")
        time.sleep(notifier.nap(NAP))
    log.error("the link has ended by itself; start it again")
    return 1
