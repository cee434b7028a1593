"""The other end of a round trip: a process of its own that answers over the bus, a pipe or raw Zenoh.

The parent says on standard input what to serve next and how many rounds; so both ways alternate
within one pair of processes. Messages go in and out as objects on every way, with the same codec.
"""

import json
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import mkdtemp
from time import perf_counter
from typing import Any

import uorb_net as uorb
from uorb_net.msg import SensorCombined

CODEC = SensorCombined.__uorb__
SIZE: int = CODEC.payload_length
GRAVITY = (0.0, 0.0, -9.8)
WAIT = 10.0  # seconds; a round that takes longer ends the benchmark


def sample(number: int) -> Any:
    """Return a fresh 48-byte message."""
    return SensorCombined(timestamp=number + 1, gyro_rad=(0.1, 0.2, 0.3), accelerometer_m_s2=GRAVITY)


def exchange(send: Callable[[bytes], object], receive: Callable[[], bytes], n: int) -> float:
    """Do `n` round trips over something that carries bytes; return the seconds they took."""
    encode, decode = CODEC.encode, CODEC.decode
    start = perf_counter()
    for number in range(n):
        send(encode(sample(number), 0))
        decode(receive(), 0)
    return perf_counter() - start


def answer(send: Callable[[bytes], object], receive: Callable[[], bytes], n: int) -> None:
    """Be the other end of `exchange`."""
    encode, decode = CODEC.encode, CODEC.decode
    for _ in range(n):
        message = decode(receive(), 0)
        send(encode(sample(message.timestamp), 0))


class Bus:
    """A ping and a pong topic on a broker; instance 0 goes out, instance 1 comes back."""

    def __init__(self, broker: uorb.Broker, near: bool) -> None:
        topics = ("sensor_combined", "vehicle_imu_echo")
        out, back = topics if near else topics[::-1]
        self.publication = broker.advertise(PONG if out == topics[1] else SensorCombined)
        self.subscription = broker.subscribe(PONG if back == topics[1] else SensorCombined, start="new")
        self.kind = PONG if out == topics[1] else SensorCombined

    def exchange(self, n: int) -> float:
        """Do `n` round trips."""
        publish, wait, copy, kind = (
            self.publication.publish,
            self.subscription.wait,
            self.subscription.copy,
            self.kind,
        )
        start = perf_counter()
        for number in range(n):
            publish(kind(timestamp=number + 1, gyro_rad=(0.1, 0.2, 0.3), accelerometer_m_s2=GRAVITY))
            if not wait(WAIT):
                raise TimeoutError(f"no answer in round {number}")
            copy()
        return perf_counter() - start

    def answer(self, n: int) -> None:
        """Be the other end."""
        publish, wait, copy, kind = (
            self.publication.publish,
            self.subscription.wait,
            self.subscription.copy,
            self.kind,
        )
        for _ in range(n):
            wait(WAIT)
            message = copy()
            publish(
                kind(
                    timestamp=message.timestamp,
                    gyro_rad=message.gyro_rad,
                    accelerometer_m_s2=GRAVITY,
                )
            )


def _pong_type() -> type[Any]:
    from uorb_net import messages

    text = messages.definition("SensorCombined")
    body = "\n".join(line for line in text.splitlines() if not line.startswith("# TOPICS"))
    return messages.from_text("VehicleImuEcho", body)


PONG = _pong_type()


class Raw:
    """Raw Zenoh between two processes: declared publisher, DROP, express off, a ring that is drained."""

    def __init__(self, near: bool, port: int) -> None:
        import zenoh

        config = zenoh.Config()
        settings = {
            "mode": "peer",
            ("listen" if near else "connect") + "/endpoints": [f"tcp/127.0.0.1:{port}"],
            "scouting/multicast/enabled": False,
            "scouting/gossip/enabled": False,
            "transport/shared_memory/enabled": False,
        }
        for path, value in settings.items():
            config.insert_json5(path, json.dumps(value))
        self.session = zenoh.open(config)
        out, back = ("raw/ping", "raw/pong") if near else ("raw/pong", "raw/ping")
        self.publisher = self.session.declare_publisher(
            out, congestion_control=zenoh.CongestionControl.DROP, allowed_destination=zenoh.Locality.REMOTE
        )
        self.subscriber = self.session.declare_subscriber(back, zenoh.handlers.RingChannel(64))

    def send(self, data: bytes) -> None:
        """Put."""
        self.publisher.put(data)

    def receive(self) -> bytes:
        """Take the next."""
        return bytes(self.subscriber.recv().payload.to_bytes())

    def close(self) -> None:
        """Leave."""
        self.session.close()  # type: ignore[no-untyped-call]


class Child:
    """The process at the other end."""

    def __init__(self, module: str, cpu: int, *arguments: object, env: dict[str, str] | None = None) -> None:
        self.to_child, to_parent = os.pipe(), os.pipe()
        self.read_fd, self.write_fd = to_parent[0], self.to_child[1]
        fds = (self.to_child[0], to_parent[1])
        self.process = subprocess.Popen(
            [sys.executable, "-m", module, str(cpu), str(fds[0]), str(fds[1]), *map(str, arguments)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            pass_fds=fds,
            env={**os.environ, **(env or {})},
            cwd=Path(__file__).parents[1],
            text=True,
        )
        for fd in fds:
            os.close(fd)
        self.expect("ready")

    def expect(self, word: str) -> None:
        """Wait for a line of the child's."""
        assert self.process.stdout is not None
        line = self.process.stdout.readline().strip()
        if line != word:
            raise RuntimeError(f"the other end said {line!r}, {word!r} was expected")

    def serve(self, what: str, n: int) -> None:
        """Make the child answer `n` rounds of `what`."""
        assert self.process.stdin is not None
        self.process.stdin.write(f"{what} {n}\n")
        self.process.stdin.flush()
        self.expect("go")

    def close(self) -> None:
        """End the child."""
        assert self.process.stdin is not None
        self.process.stdin.close()
        self.process.wait(10)


def serve(ways: dict[str, Callable[[int], None]]) -> None:
    """Run as the child: answer what the parent asks for until its end of the pipe closes."""
    print("ready", flush=True)
    for line in sys.stdin:
        what, n = line.split()
        print("go", flush=True)
        ways[what](int(n))


@contextmanager
def runtime_folder() -> Iterator[str]:
    """Yield a fresh runtime directory on a RAM file system; it is removed after."""
    from shutil import rmtree

    folder = mkdtemp(prefix="uorb-bench-", dir="/dev/shm" if os.path.isdir("/dev/shm") else None)
    try:
        yield folder
    finally:
        rmtree(folder, ignore_errors=True)


@contextmanager
def pinned(cpu: int) -> Iterator[None]:
    """Run this process on one CPU meanwhile."""
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {cpu})
    try:
        yield
    finally:
        os.sched_setaffinity(0, before)
