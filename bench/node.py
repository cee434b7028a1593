"""What a node costs in one process: check, and publish + check + copy, on the shared and the private bus.

Controls: `check` against a bare compare of a mapped 64-bit word done in a method; publish + check +
copy against put and receive over one raw Zenoh session, with the same codec and a fresh message each.
"""

import json
import mmap
import os
from collections.abc import Callable
from math import inf

import uorb_net as uorb
from bench.echo import CODEC, runtime_folder, sample
from bench.ratios import Row, Timed, alternate, count_for, print_table, row, timed
from uorb_net.msg import SensorCombined

GOAL_CHECK = 2.5
GOAL_COPY = 0.9
ROUNDS = 15


class Word:
    """A bare compare of a mapped word, as a method."""

    def __init__(self) -> None:
        self.words = memoryview(mmap.mmap(-1, 4096)).cast("Q")
        self.seen = 0

    def check(self) -> bool:
        """Tell whether the word has changed."""
        return self.words[8] != self.seen


def run(seconds: float = 4.0) -> list[Row]:
    """Measure for about so many seconds."""
    with runtime_folder() as folder:
        os.environ["UORB_RUNTIME_DIR"] = folder
        with uorb.Broker("bench") as shared, uorb.Broker.private() as private:
            rows = [
                _check(shared, seconds / 3),
                _copy("shared bus", shared, seconds / 3),
                _copy("private bus", private, seconds / 3),
                _prototype(private, seconds / 3),
            ]
        del os.environ["UORB_RUNTIME_DIR"]
    return rows


def _check(broker: uorb.Broker, seconds: float) -> Row:
    broker.advertise(SensorCombined, sample(0))
    subscription = broker.subscribe(SensorCombined)
    subscription.copy()
    word = Word()
    ours, control = _calls(subscription.check), _calls(word.check)
    n = count_for(control, seconds / (2 * ROUNDS))
    return row("check, nothing new / bare compare", alternate(ours, control, ROUNDS, n), GOAL_CHECK)


def _calls(method: Callable[[], object]) -> Timed:
    def loop(n: int) -> None:
        call = method
        for _ in range(n):
            call()

    return timed(loop)


def _copy(name: str, broker: uorb.Broker, seconds: float) -> Row:
    publication = broker.advertise(SensorCombined)
    subscription = broker.subscribe(SensorCombined)

    def ours(n: int) -> None:
        publish, check, copy = publication.publish, subscription.check, subscription.copy
        for number in range(n):
            publish(sample(number))
            if check():
                copy()

    raw, close = _zenoh()
    n = count_for(raw, seconds / (2 * ROUNDS))
    measured = alternate(timed(ours), raw, ROUNDS, n)
    close()
    return row(f"publish + check + copy, {name} / raw Zenoh", measured, GOAL_COPY)


class Prototype:
    """The least that could be called a bus: a reference and a count in one process, no lock, no encoding."""

    def __init__(self) -> None:
        self.message: object = None
        self.generation = 0

    def publish(self, message: object) -> None:
        """Hand over a reference."""
        self.message = message
        self.generation += 1

    def check(self, position: int) -> bool:
        """Tell whether there is something new."""
        return self.generation != position

    def copy(self) -> object:
        """Return the reference."""
        return self.message


def _prototype(broker: uorb.Broker, seconds: float) -> Row:
    publication = broker.advertise(SensorCombined)
    subscription = broker.subscribe(SensorCombined)
    bare = Prototype()

    def ours(n: int) -> None:
        for number in range(n):
            publication.publish(sample(number))
            if subscription.check():
                subscription.copy()

    def control(n: int) -> None:
        for number in range(n):
            bare.publish(sample(number))
            if bare.check(number):
                bare.copy()

    n = count_for(timed(control), seconds / (4 * ROUNDS))
    measured = alternate(timed(ours), timed(control), ROUNDS, n)
    return row(
        "publish + check + copy / a bare reference", measured, inf, "for scale: no lock, no encoding, one process"
    )


def _zenoh() -> tuple[Timed, Callable[[], None]]:
    import zenoh

    config = zenoh.Config()
    for path in ("scouting/multicast/enabled", "scouting/gossip/enabled", "transport/shared_memory/enabled"):
        config.insert_json5(path, json.dumps(False))
    config.insert_json5("mode", json.dumps("peer"))
    session = zenoh.open(config)
    subscriber = session.declare_subscriber("bench/sensor", zenoh.handlers.FifoChannel(64))
    publisher = session.declare_publisher("bench/sensor")
    encode, decode = CODEC.encode, CODEC.decode

    def loop(n: int) -> None:
        put, receive = publisher.put, subscriber.recv
        for number in range(n):
            put(encode(sample(number), 0))
            decode(receive().payload.to_bytes(), 0)

    return timed(loop), session.close


if __name__ == "__main__":
    print_table(run())
