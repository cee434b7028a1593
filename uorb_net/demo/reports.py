"""What the demo's processes tell each other: the plan at the start, commands down, reports up.

One datagram of JSON each, over a socket pair whose end of file tells that the other side is gone.
"""

import msgspec

from ..link import LinkStats, PeerStatus
from .rotations import Vector

AUTOPILOT, COMPANION = "autopilot", "companion"
REPORT_EVERY = 1.0  # seconds
QUIET_EVERY = 0.1  # seconds, once a host publishes no more

# Commands; "connect ENDPOINT" is the third.
QUIET = "quiet"  # publish no more, receive on
STOP = "stop"


class Plan(msgspec.Struct, frozen=True):
    """What a host's process is to do.

    Attributes:
        host: its name.
        socket: descriptor of its end of the pair.
        folder: the demo's, which is to go with its last process.
        seed: of all chance in the simulation.
        log: a ULog file to play instead; empty for the simulation.
    """

    host: str
    socket: int
    folder: str
    seed: int
    log: str


class Row(msgspec.Struct, frozen=True):
    """A topic instance of another host, as received here.

    Attributes:
        topic, instance, origin: as numbered on this host's bus.
        rate: Hz over the last report's time.
        received: samples so far.
        lost: samples this host's reader was too slow for.
        net_lost: samples that did not arrive.
        early: samples published before this host subscribed.
        age: seconds since the newest was published; None where the clocks cannot be compared.
        latency: mean seconds from publication to this host's bus; None likewise.
    """

    topic: str
    instance: int
    origin: str
    rate: float
    received: int
    lost: int
    net_lost: int
    early: int
    age: float | None
    latency: float | None


class Attitude(msgspec.Struct, frozen=True):
    """The vehicle's attitude and the companion's estimate at one moment, roll, pitch, yaw in degrees.

    `mean` and `worst` are of the angle between them, over `count` samples.
    """

    vehicle: Vector
    own: Vector
    mean: float
    worst: float
    count: int


class Report(msgspec.Struct, frozen=True):
    """The state of one host.

    Attributes:
        host: its name.
        published: samples so far.
        rows: what it receives from other hosts.
        peers, link: as its link tells them; None before the link is started.
        cpu: share of one core used since the report before.
        endpoint: where it listens; empty if it does not.
        attitude: of the companion alone.
        event: the newest event of the link but for comings and goings.
        quiet: whether it publishes no more.
        done: what it came to publish is published; `problem` what was wrong with it.
    """

    host: str
    published: int
    rows: list[Row]
    peers: list[PeerStatus]
    link: LinkStats | None
    cpu: float
    endpoint: str = ""
    attitude: Attitude | None = None
    event: str = ""
    quiet: bool = False
    done: bool = False
    problem: str = ""
