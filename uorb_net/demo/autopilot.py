"""The host `autopilot`: flies the simulated vehicle, or plays a log, and publishes on its own bus."""

from random import Random
from time import monotonic

from ..errors import UorbError
from ..logs.player import Series, play
from ..logs.sink import BusSink
from ..logs.ulog import LogError
from .host import Host, run
from .pilot import fly
from .sensors import Sensors
from .telemetry import INTERVAL_US, RATE, Telemetry
from .vehicle import State, step

SUBSTEPS = 2  # of physics between two ticks of the sensors
LATE = 0.2  # seconds behind its clock after which the flight lets the time pass


class Flight:
    """A simulated flight: the same one for the same seed."""

    def __init__(self, seed: int) -> None:
        self.state = State()
        self.sensors = Sensors(Random(f"sensors {seed}"))
        self._random = Random(f"air {seed}")  # its own, so that no sensor's reading changes the weather

    def tick(self) -> State:
        """Fly on to the next tick."""
        for _ in range(SUBSTEPS):
            self.state = step(self.state, fly(self.state), 1.0 / (RATE * SUBSTEPS), self._random)
        return self.state


def simulate(host: Host) -> None:
    """Fly in real time until the parent wants quiet."""
    flight = Flight(host.plan.seed)
    telemetry = Telemetry(host, flight.sensors)
    host.listen()
    number, begin = 0, monotonic()
    while not host.quiet:
        due = begin + number / RATE
        host.serve(due)
        late = monotonic() - due
        if late > LATE:
            begin += late
        telemetry.tick(number, flight.tick(), int(begin * 1e6) + number * INTERVAL_US)
        number += 1


class _Hushed(Exception):  # noqa: N818 - not an error
    """The parent wants quiet in the middle of a log."""


class Stage:
    """Where a log's samples go: the bus, for as long as the parent wants them."""

    def __init__(self, host: Host) -> None:
        self._host = host
        self._bus = BusSink(host.broker, self._refused)

    def _refused(self, series: Series, error: UorbError) -> None:
        raise error  # the bus is the demo's own: nobody else can have been here before

    def advertise(self, series: Series) -> None:
        """Advertise a series before all samples."""
        self._bus.advertise(series)

    def publish(self, series: Series, payload: bytes) -> None:
        """Publish a sample."""
        if self._host.quiet:
            raise _Hushed
        self._bus.publish(series, payload)
        self._host.published += 1

    def wait(self, seconds: float) -> None:
        """Do what a host does beside publishing, until the next sample is due."""
        if self._host.quiet:
            raise _Hushed
        self._host.serve(monotonic() + seconds)


def replay(host: Host) -> None:
    """Play the plan's log in real time."""
    stage = Stage(host)
    host.listen()
    try:
        played = play(host.plan.log, stage, rate=1.0, sleep=stage.wait)
    except _Hushed:
        return
    if not played.samples:
        raise LogError(f"{host.plan.log} has no samples")
    host.done, host.problem = True, played.problem


def _work(host: Host) -> None:
    if host.plan.log:
        replay(host)
    else:
        simulate(host)


if __name__ == "__main__":
    raise SystemExit(run(_work))
