"""One way between two processes: latency at 1 kHz, lossless throughput of a queue, a message of 1 MiB.

Controls: a bare pipe for latency, pyzmq over ipc for throughput and size, each with the same codec.
Both processes read one clock (CLOCK_MONOTONIC), so a one-way time is a difference of two stamps.
"""

import os
import sys
from collections.abc import Callable
from statistics import median
from time import monotonic_ns, perf_counter, sleep
from typing import Any

import uorb_net as uorb
from bench.echo import CODEC, SIZE, Child, runtime_folder, sample, serve
from bench.ratios import Measured, Row, print_table, row
from uorb_net import messages
from uorb_net.msg import OrbTest, SensorCombined

ROUNDS = 9
WINDOW = 200  # samples in flight, of a queue of 255
IMAGE = messages.from_text("BenchImage", "uint64 timestamp\nuint8[1048576] data\n")
PIXELS = bytes(range(256)) * 4096


def run(seconds: float = 6.0) -> list[Row]:
    """Measure all three, an end per CPU."""
    with runtime_folder() as folder:
        os.environ["UORB_RUNTIME_DIR"] = folder
        cpus = sorted(os.sched_getaffinity(0))[:2]
        before = os.sched_getaffinity(0)
        os.sched_setaffinity(0, {cpus[0]})
        try:
            with uorb.Broker("bench") as broker:
                near = Near(broker, Child("bench.flow", cpus[-1], folder), folder)
                rows = near.rows(seconds)
                near.close()
        finally:
            os.sched_setaffinity(0, before)
            del os.environ["UORB_RUNTIME_DIR"]
    return rows


class Near:
    """The sending process."""

    def __init__(self, broker: uorb.Broker, child: Child, folder: str) -> None:
        import zmq

        self.child = child
        self.queue = broker.advertise(SensorCombined, queue_length=255)
        self.image = broker.advertise(IMAGE, queue_length=8)
        self.acknowledged = broker.subscribe(OrbTest)
        self.push: Any = zmq.Context.instance().socket(zmq.PUSH)
        self.push.set_hwm(WINDOW // 2)
        self.push.connect(f"ipc://{folder}/push")

    def rows(self, seconds: float) -> list[Row]:
        """Measure, alternating round by round; the child tells each round's figure in µs."""
        paced = max(100, int(seconds * 1000 / ROUNDS / 6))
        flat = int(seconds * 100_000 / ROUNDS / 6)
        images = max(20, int(seconds * 300 / ROUNDS / 6))
        return [
            row("one way at 1 kHz, p50 / a pipe", self._alternate("hz", "hz_pipe", paced), 1.4),
            self._throughput(flat),
            row("1 MiB one way, p50 / pyzmq ipc", self._alternate("image", "image_zmq", images), 0.6),
        ]

    def _throughput(self, n: int) -> Row:
        measured = self._alternate("queue", "queue_zmq", n)
        rate = 1e6 / measured.ours_us
        remark = f"{rate:,.0f} msg/s, nothing lost, {WINDOW} in flight" + (
            "" if rate >= 100_000 else " (goal: 100,000)"
        )
        return row("queue of 255, time a message / pyzmq ipc", measured, 2.0, remark)

    def _alternate(self, ours: str, control: str, n: int) -> Measured:
        pairs = []
        for index in range(ROUNDS + 1):
            order = (ours, control) if index % 2 else (control, ours)
            figures = {what: self._round(what, n) for what in order}
            pairs.append((figures[ours], figures[control]))
        pairs = pairs[1:]  # the first warms up
        return Measured(median(a / b for a, b in pairs), median(a for a, _ in pairs), median(b for _, b in pairs))

    def _round(self, what: str, n: int) -> float:
        self.child.serve(what, n)
        self.child.expect("listening")
        getattr(self, "_" + what)(n)
        assert self.child.process.stdout is not None
        return float(self.child.process.stdout.readline())

    def _hz(self, n: int) -> None:
        _paced(n, lambda: self.queue.publish(SensorCombined(timestamp=monotonic_ns(), gyro_rad=(0.1, 0.2, 0.3))))

    def _hz_pipe(self, n: int) -> None:
        def send() -> None:
            message = SensorCombined(timestamp=monotonic_ns(), gyro_rad=(0.1, 0.2, 0.3))
            os.write(self.child.write_fd, CODEC.encode(message, 0))

        _paced(n, send)

    def _queue(self, n: int) -> None:
        self.acknowledged.update()  # the last of the round before
        acknowledged = 0
        for number in range(n):
            while number - acknowledged >= WINDOW:
                if not self.acknowledged.wait(5.0):
                    raise TimeoutError("the reader stopped")
                acknowledged = self.acknowledged.copy().val
            self.queue.publish(sample(number))

    def _queue_zmq(self, n: int) -> None:
        for number in range(n):
            self.push.send(CODEC.encode(sample(number), 0))

    def _image(self, n: int) -> None:
        _paced(n, lambda: self.image.publish(IMAGE(timestamp=monotonic_ns(), data=PIXELS)), 0.003)

    def _image_zmq(self, n: int) -> None:
        encode = IMAGE.__uorb__.encode
        _paced(n, lambda: self.push.send(encode(IMAGE(timestamp=monotonic_ns(), data=PIXELS), 0)), 0.003)

    def close(self) -> None:
        """End."""
        self.push.close(0)
        self.child.close()


def _paced(n: int, send: Callable[[], object], period: float = 0.001) -> None:
    due = perf_counter()
    for _ in range(n):
        due += period
        left = due - perf_counter()
        if left > 0:
            sleep(left)
        send()


class Far:
    """The receiving process."""

    def __init__(self, broker: uorb.Broker, read_fd: int, folder: str) -> None:
        import zmq

        self.read_fd = read_fd
        self.queue = broker.subscribe(SensorCombined, start="new")
        self.image = broker.subscribe(IMAGE, start="new")
        self.acknowledge = broker.advertise(OrbTest)
        self.pull: Any = zmq.Context.instance().socket(zmq.PULL)
        self.pull.set_hwm(WINDOW // 2)
        self.pull.bind(f"ipc://{folder}/push")

    def hz(self, n: int) -> None:
        """Receive from the bus, stamped."""
        _report([self._bus(self.queue) for _ in _listening(n)])

    def hz_pipe(self, n: int) -> None:
        """Receive from the pipe, stamped."""
        _report([_age(CODEC.decode(os.read(self.read_fd, SIZE), 0)) for _ in _listening(n)])

    def image_(self, n: int) -> None:
        """Receive images from the bus."""
        _report([self._bus(self.image) for _ in _listening(n)])

    def image_zmq(self, n: int) -> None:
        """Receive images from pyzmq."""
        decode = IMAGE.__uorb__.decode
        _report([_age(decode(self.pull.recv(), 0)) for _ in _listening(n)])

    def _bus(self, subscription: Any) -> int:
        if not subscription.wait(10.0):
            raise TimeoutError("nothing came")
        return _age(subscription.copy())

    def queue_(self, n: int) -> None:
        """Receive as fast as it comes, acknowledging; nothing may be lost."""
        wait, copy, check = self.queue.wait, self.queue.copy, self.queue.check
        lost = self.queue.lost
        got = 0
        start = 0.0
        for _ in _listening(1):
            while got < n:
                if not wait(10.0):
                    raise TimeoutError("nothing came")
                start = start or perf_counter()
                while check():
                    copy()
                    got += 1
                    if not got % (WINDOW // 4):
                        self.acknowledge.publish(OrbTest(timestamp=1, val=got))
        if self.queue.lost != lost:
            raise RuntimeError(f"{self.queue.lost - lost} lost")
        print((perf_counter() - start) / n * 1e6, flush=True)

    def queue_zmq(self, n: int) -> None:
        """Receive as fast as it comes."""
        receive, decode = self.pull.recv, CODEC.decode
        start = 0.0
        for _ in _listening(n):
            decode(receive(), 0)
            start = start or perf_counter()
        print((perf_counter() - start) / n * 1e6, flush=True)


def _age(message: Any) -> int:
    """Return the nanoseconds since a message was stamped; called after it was decoded."""
    return monotonic_ns() - int(message.timestamp)


def _listening(n: int) -> "range":
    print("listening", flush=True)
    return range(n)


def _report(times_ns: list[int]) -> None:
    print(median(times_ns) / 1000, flush=True)


def _child(cpu: int, read_fd: int, folder: str) -> None:
    os.sched_setaffinity(0, {cpu})
    with uorb.Broker("bench") as broker:
        far = Far(broker, read_fd, folder)
        ways: dict[str, Callable[[int], None]] = {
            "hz": far.hz,
            "hz_pipe": far.hz_pipe,
            "image": far.image_,
            "image_zmq": far.image_zmq,
            "queue": far.queue_,
            "queue_zmq": far.queue_zmq,
        }
        serve(ways)
        far.pull.close(0)


if __name__ == "__main__":
    if len(sys.argv) > 1:
        _child(int(sys.argv[1]), int(sys.argv[2]), sys.argv[4])
    else:
        print_table(run())
