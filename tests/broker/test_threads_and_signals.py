"""Threads and signal handlers on one publication; closing and unadvertising under threads at work."""

import threading
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import pytest

import uorb_net as uorb
from uorb_net.broker.shared import process_directory
from uorb_net.msg import OrbTest, OrbTestMedium

if TYPE_CHECKING:
    from tests.conftest import Script, Task

InThread = Callable[[Callable[[], object]], "Task"]
Start = Callable[..., "Script"]


def test_four_threads_publish_two_read(broker: uorb.Broker, in_thread: InThread) -> None:
    """G is the sum; readers see every number once, in order, or count it lost; each thread's samples in order."""
    count, total = 2000, 8000
    publication = broker.advertise(OrbTest, queue_length=255)

    def write(thread: int) -> None:
        for value in range(count):
            publication.publish(OrbTest(timestamp=thread + 1, val=value))

    subscriptions = [broker.subscribe(OrbTest, start="oldest") for _ in range(2)]

    def follow(subscription: uorb.Subscription[OrbTest]) -> int:
        newest: dict[int, int] = {}
        delivered = 0
        while subscription.generation < total:
            assert subscription.wait(20.0)
            message, info = subscription.copy_with_info()
            delivered += 1
            assert info.generation == delivered + subscription.lost
            assert newest.get(message.timestamp, -1) < message.val
            newest[message.timestamp] = message.val
        return delivered

    readers = [in_thread(lambda s=s: follow(s)) for s in subscriptions]  # type: ignore[misc]
    writers = [in_thread(lambda n=n: write(n)) for n in range(4)]  # type: ignore[misc]
    for writer in writers:
        writer.result(30.0)
    for reader, subscription in zip(readers, subscriptions):
        delivered = reader.result(30.0)
        assert isinstance(delivered, int)
        assert delivered + subscription.lost == total
    [status] = broker.topics()
    assert (status.generation, status.lost) == (total, sum(s.lost for s in subscriptions))


SIGNALS = """
broker = uorb.Broker(){private}
keeper = {keeper}
pub = broker.advertise("orb_test", queue_length=255)
sub = broker.subscribe("orb_test")
handled, inside = 0, False
def handler(*_):
    global handled, inside
    if inside: return  # it was interrupted by the next signal, and would number its own samples twice
    inside = True
    handled += 1
    pub.publish(msg.OrbTest(timestamp=2, val=handled))
    inside = False
signal.signal(signal.SIGALRM, handler)
signal.setitimer(signal.ITIMER_REAL, 0.001, 0.001)
seen = {{1: [], 2: []}}
main = 0
until = time.monotonic() + 1.5
while time.monotonic() < until:
    for _ in range(20):
        main += 1
        pub.publish(msg.OrbTest(timestamp=1, val=main))
    for m in iter(sub.update, None): seen[m.timestamp].append(m.val)
signal.setitimer(signal.ITIMER_REAL, 0)
for m in iter(sub.update, None): seen[m.timestamp].append(m.val)
say(seen[1] == list(range(1, main + 1)), seen[2] == list(range(1, handled + 1)), handled > 50, sub.lost)
say(broker.topics()[0].generation == main + handled)
"""


@pytest.mark.parametrize("kind", ["private", "solo", "shared"])
def test_a_signal_handler_publishes_too(shared: uorb.Broker, script: Start, kind: str) -> None:
    """1 kHz from a handler into the topic the main thread publishes on: no deadlock, every sample, in order."""
    other = shared.advertise(OrbTest, queue_length=255) if kind == "shared" else None
    child = script(SIGNALS.format(private=".private()" if kind == "private" else "", keeper=other is not None))
    assert child.hear() == "True True True 0"
    assert child.hear() == "True"


def test_a_handler_that_publishes_in_the_act(broker: uorb.Broker) -> None:
    """A publish that interrupts a publish is put aside and comes right after, whatever thread writes next."""
    publication = broker.advertise(OrbTest, queue_length=8)
    subscription = broker.subscribe(OrbTest)
    mapping = publication._node.mapping
    pack = mapping.pack

    def interrupted(*fields: Any) -> None:
        mapping.pack = pack
        for value in (2, 3):
            publication.publish(OrbTest(val=value))
        pack(*fields)

    mapping.pack = interrupted
    publication.publish(OrbTest(val=1))
    publication.publish(OrbTest(val=4))
    assert [m.val for m in iter(subscription.update, None)] == [1, 2, 3, 4]


def test_samples_put_aside_may_be_written_by_another_thread(broker: uorb.Broker) -> None:
    """A thread that goes to write what a handler left, and finds it written, goes on."""

    class Taken(list[Any]):
        def __bool__(self) -> bool:
            return True

    publication = broker.advertise(OrbTest)
    publication._node._deferred = Taken()
    publication.publish(OrbTest())
    assert broker.topics()[0].generation == 1


def test_iterating_while_a_publisher_comes_and_goes(broker: uorb.Broker, in_thread: InThread) -> None:
    """A reader in a loop never sees an exception, and the newest sample in the end."""
    subscription = broker.subscribe(OrbTest)

    def read() -> object:
        return next(message.val for message in subscription if message.val >= 400)

    task = in_thread(read)
    for value in range(401):
        with broker.advertise(OrbTest) as publication:
            publication.publish(OrbTest(val=value))
            while value == 400 and not task.done():
                task.thread.join(0.01)
    assert task.result() == 400


def test_unadvertise_while_another_thread_publishes(broker: uorb.Broker, in_thread: InThread) -> None:
    """The publishing thread gets ClosedError, never another error, and nothing more is written."""
    for _ in range(60):
        publication = broker.advertise(OrbTest)
        started = threading.Event()

        def write(publication: uorb.Publication[OrbTest] = publication, started: Any = started) -> None:
            while True:
                publication.publish(OrbTest())
                started.set()

        task = in_thread(write)
        assert started.wait(10.0)
        publication.unadvertise()
        generation = broker.topics()[0].generation
        with pytest.raises(uorb.ClosedError):
            task.result()
        assert broker.topics()[0].generation == generation
        assert not broker.exists(OrbTest)


def test_threads_advertise_and_unadvertise_at_random(broker: uorb.Broker, in_thread: InThread) -> None:
    """Counting stays right: G is the sum of the publications, and nobody is left at the end."""

    def work() -> int:
        for round_ in range(60):
            with broker.advertise(OrbTest) as publication, broker.subscribe(OrbTest) as subscription:
                for value in range(round_ % 7):
                    publication.publish(OrbTest(val=value))
                subscription.update()
        return sum(round_ % 7 for round_ in range(60))

    tasks = [in_thread(work) for _ in range(4)]
    total = sum(int(str(task.result(30.0))) for task in tasks)
    [status] = broker.topics()
    assert status.generation == total
    assert (status.advertised, status.publishers, status.subscribers) == (False, 0, 0)
    assert not broker._directory.nodes


def test_multi_instances_from_threads(broker: uorb.Broker, in_thread: InThread) -> None:
    """Ten threads get ten instances."""
    barrier = threading.Barrier(10)

    def work() -> int:
        barrier.wait(10.0)
        return broker.advertise_multi("orb_multitest").instance

    tasks = [in_thread(work) for _ in range(10)]
    assert sorted(int(str(task.result())) for task in tasks) == list(range(10))


def test_close_while_another_thread_reads(broker: uorb.Broker, in_thread: InThread) -> None:
    """Every read ends with ClosedError and stays closed, whatever the moment."""
    publication = broker.advertise(OrbTestMedium)
    for value in range(40):
        publication.publish(OrbTestMedium(val=value))
        subscription = broker.subscribe(OrbTestMedium)

        def read(subscription: uorb.Subscription[OrbTestMedium] = subscription) -> None:
            while True:
                subscription.update()
                subscription.wait(0.001)
                subscription.copy_with_info()

        task = in_thread(read)
        task.thread.join(0.002 * (value % 3))
        subscription.close()
        with pytest.raises(uorb.ClosedError):
            task.result()
        with pytest.raises(uorb.ClosedError):
            subscription.check()
    assert broker.topics()[0].subscribers == 0


def test_a_broker_opened_while_the_last_other_one_closes(
    runtime_dir: object, monkeypatch: pytest.MonkeyPatch, in_thread: InThread
) -> None:
    """The folder is not closed under a broker that has just been opened on it."""
    first = uorb.Broker()

    def while_closing(vehicle: str) -> Any:
        directory = process_directory(vehicle)
        in_thread(first.close).thread.join(0.2)
        return directory

    monkeypatch.setattr("uorb_net.broker.broker.process_directory", while_closing)
    with uorb.Broker() as second:
        assert second.topics() == []
        second.advertise(OrbTest, OrbTest(val=1))
        assert second.subscribe(OrbTest).copy().val == 1


CLOSES = """
import gc
faults, slowest, counts = [], 0.0, []
def ends(work, *arguments):
    def run():
        try: work(*arguments)
        except uorb.ClosedError: pass
        except BaseException as error: faults.append(repr(error))
    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    return thread
def publish(publication):
    while True: publication.publish(msg.OrbTest())
def read(subscription):
    while True: subscription.wait(); subscription.update()
def advertise(broker):
    while True: broker.advertise_multi("orb_multitest").unadvertise()
for n in range(30):
    broker = uorb.Broker()
    threads = [ends(publish, broker.advertise("orb_test")), ends(read, broker.subscribe("orb_test")),
        ends(read, broker.subscribe("orb_test_medium")), ends(advertise, broker)]
    threads[0].join(0.003 * (n % 5))
    started = time.monotonic()
    broker.close()
    for thread in threads:
        thread.join(5)
        if thread.is_alive(): faults.append("hangs")
    slowest = max(slowest, time.monotonic() - started)
    faults += [name for name in os.listdir(broker.path) if name.startswith(".w")]
    del threads
    gc.collect()
    counts.append(len(os.listdir("/proc/self/fd")))
say(faults, slowest < 1.0, max(counts[5:]) <= max(counts[:5]) + 1)
"""


def test_closing_the_broker_under_threads_at_work(script: Start) -> None:
    """Publishing, waiting and advertising threads all end with ClosedError at once; no descriptor stays open."""
    assert script(CLOSES).hear() == "[] True True"


def test_waits_of_threads_that_come_and_go(broker: uorb.Broker, in_thread: InThread) -> None:
    """Many short waits of many threads on changing nodes: nobody misses a publication for long."""
    topics = ["orb_test", "orb_multitest", "orb_test_medium", "orb_test_large"]
    publications = [broker.advertise(topic) for topic in topics]

    def read(topic: str) -> int:
        found = 0
        for _ in range(40):
            with broker.subscribe(topic, start="new") as subscription:
                found += subscription.wait(5.0)
        return found

    tasks = [in_thread(lambda t=topic: read(t)) for topic in topics * 2]  # type: ignore[misc]
    while not all(task.done() for task in tasks):
        for publication in publications:
            publication.publish(publication.type.cls())
        tasks[0].thread.join(0.001)
    assert [task.result() for task in tasks] == [40] * 8
