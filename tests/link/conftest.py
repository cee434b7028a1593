"""Hosts joined by a real Zenoh link over loopback TCP, or by a network in memory: one suite, two places."""

import socket
from collections.abc import Callable, Iterator
from time import monotonic, sleep

import pytest

import uorb_net as uorb
from communicator import Channel, MemoryNetwork, ZenohChannel


def free_port() -> int:
    """Return a TCP port nobody listens on."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def until(condition: Callable[[], object], seconds: float = 5.0) -> bool:
    """Wait until `condition` holds, at most `seconds`."""
    deadline = monotonic() + seconds
    while not condition():
        if monotonic() > deadline:
            return False
        sleep(0.002)
    return True


class Vehicle:
    """Hosts of one vehicle, each a private bus with its link."""

    def __init__(self, kind: str) -> None:
        self.kind = kind
        self.network = MemoryNetwork()
        self.ports: list[int] = []
        self.links: list[uorb.Link] = []

    def channel(self) -> Channel:
        """Return a channel that reaches all channels made before."""
        if self.kind == "memory":
            return self.network.channel()
        self.ports.append(free_port())
        *others, own = [f"tcp/127.0.0.1:{port}" for port in self.ports]
        return ZenohChannel(listen=[own], connect=others)

    def host(self, name: str, broker: uorb.Broker | None = None) -> tuple[uorb.Broker, uorb.Link]:
        """Start a host, on a given bus or a fresh one, and wait until all hosts see each other."""
        broker = broker or uorb.Broker.private()
        link = uorb.Link(broker, self.channel(), host=name)
        link.start()
        for other in self.links:
            assert link.wait_for_peer(other.host, 5.0)
            assert other.wait_for_peer(name, 5.0)
        self.links.append(link)
        return broker, link

    def close(self) -> None:
        """Stop every host."""
        for link in self.links:
            link.broker.close()


@pytest.fixture(params=["memory", "zenoh"])
def vehicle(request: pytest.FixtureRequest) -> Iterator[Vehicle]:
    """A vehicle over each kind of channel."""
    vehicle = Vehicle(request.param)
    yield vehicle
    vehicle.close()


@pytest.fixture
def eventually() -> Callable[..., bool]:
    """Wait for a condition."""
    return until
