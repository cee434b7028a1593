"""Hosts joined by a real Zenoh link over loopback TCP, or by a network in memory: one suite, two places."""

from collections.abc import Callable, Iterator

import pytest

import uorb_net as uorb
from communicator import Channel, MemoryNetwork, ZenohChannel


class Vehicle:
    """Hosts of one vehicle, each a private bus with its link."""

    def __init__(self, kind: str, free_endpoint: Callable[[], str]) -> None:
        self.kind = kind
        self.network = MemoryNetwork()
        self.free_endpoint = free_endpoint
        self.endpoints: list[str] = []
        self.links: list[uorb.Link] = []

    def channel(self) -> Channel:
        """Return a channel that reaches all channels made before."""
        if self.kind == "memory":
            return self.network.channel()
        self.endpoints.append(self.free_endpoint())
        *others, own = self.endpoints
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
def vehicle(request: pytest.FixtureRequest, free_endpoint: Callable[[], str]) -> Iterator[Vehicle]:
    """A vehicle over each kind of channel."""
    vehicle = Vehicle(request.param, free_endpoint)
    yield vehicle
    vehicle.close()
