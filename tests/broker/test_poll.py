"""Waiting and polling within one process: level triggered, in order, nothing missed, ended by closing."""

import resource
from collections.abc import Callable
from functools import partial
from time import monotonic
from typing import TYPE_CHECKING, Any

import pytest

import uorb_net as uorb
from uorb_net.msg import OrbTest, OrbTestMedium

if TYPE_CHECKING:
    from tests.conftest import Task

InThread = Callable[[Callable[[], object]], "Task"]


def test_poll_is_level_triggered(broker: uorb.Broker) -> None:
    """A ready subscription is returned at once, every time, until it is copied."""
    publication = broker.advertise(OrbTest)
    subscription = broker.subscribe(OrbTest)
    assert uorb.poll([subscription], 0) == []
    publication.publish(OrbTest())
    assert all(uorb.poll([subscription], 5.0) == [subscription] for _ in range(3))
    subscription.copy()
    assert uorb.poll([subscription], 0) == []


def test_poll_returns_all_that_are_ready_in_order_each_once(broker: uorb.Broker) -> None:
    """The order is that of the argument; one given twice comes once."""
    readers = [broker.subscribe("orb_multitest", instance) for instance in range(4)]
    writers = [broker.advertise_multi("orb_multitest") for _ in range(4)]
    for writer in (writers[3], writers[1]):
        writer.publish(OrbTest())
    assert uorb.poll(readers, 5.0) == [readers[1], readers[3]]
    assert uorb.poll(readers[::-1], 5.0) == [readers[3], readers[1]]
    assert uorb.poll([readers[3], readers[0], readers[3]], 5.0) == [readers[3]]


def test_poll_over_several_buses(private: uorb.Broker, shared: uorb.Broker) -> None:
    """Subscriptions of a private and a shared bus wait together."""
    readers = [bus.subscribe(OrbTest) for bus in (private, shared)]
    writers = [bus.advertise(OrbTest) for bus in (private, shared)]
    for reader, writer in zip(readers, writers):
        writer.publish(OrbTest())
        assert uorb.poll(readers, 5.0) == [reader]
        reader.copy()


@pytest.mark.parametrize("which", ["wait", "poll"])
def test_a_wait_ends_with_the_publication(broker: uorb.Broker, in_thread: InThread, which: str) -> None:
    """A thread that sleeps is woken by another's publish, well before it would look again by itself."""
    publication = broker.advertise(OrbTest)
    subscription = broker.subscribe(OrbTest)

    def sleep() -> float:
        assert subscription.wait(20.0) if which == "wait" else uorb.poll([subscription], 20.0)
        return monotonic()

    late = 0
    for _ in range(5):
        task = in_thread(sleep)
        task.thread.join(0.25)  # by now its next look is up to a second away
        assert not task.done()
        published = monotonic()
        publication.publish(OrbTest())
        woken = task.result()
        assert isinstance(woken, float)
        late += woken - published > 0.2
        subscription.copy()
    assert late <= 1


def test_timeouts(broker: uorb.Broker) -> None:
    """Seconds; 0 and less do not wait; nothing ready is False, or an empty list."""
    subscription = broker.subscribe(OrbTest)
    for timeout in (0, -1.0):
        started = monotonic()
        assert not subscription.wait(timeout)
        assert uorb.poll([subscription], timeout) == []
        assert monotonic() - started < 0.1
    started = monotonic()
    assert not subscription.wait(0.15)
    assert 0.15 <= monotonic() - started < 1.0
    started = monotonic()
    assert uorb.poll([subscription], 0.15) == []
    assert 0.15 <= monotonic() - started < 1.0


def test_poll_of_nothing() -> None:
    """`poll([])` waits out its timeout; without one it would wait for ever and is a ValueError."""
    started = monotonic()
    assert uorb.poll([], 0.1) == []
    assert monotonic() - started >= 0.1
    assert uorb.poll([], -1.0) == []
    with pytest.raises(ValueError, match="for ever"):
        uorb.poll([])


def test_what_does_not_wake(broker: uorb.Broker, in_thread: InThread) -> None:
    """Publishing elsewhere, advertising without data, and unadvertising end no wait."""
    subscription = broker.subscribe("orb_multitest", 1)
    others = [broker.advertise("orb_multitest"), broker.advertise(OrbTest)]
    task = in_thread(lambda: subscription.wait(0.6))
    for other in others * 3:
        other.publish(OrbTest())
    own = broker.advertise_multi("orb_multitest")
    assert own.instance == 1
    own.unadvertise()
    assert task.result() is False


def test_a_wait_before_anyone_advertises(broker: uorb.Broker, in_thread: InThread) -> None:
    """A subscriber may come first and sleep; the first publication wakes it, also with another queue length."""
    subscription = broker.subscribe(OrbTest)
    task = in_thread(lambda: subscription.wait(20.0))
    task.thread.join(0.05)
    publication = broker.advertise(OrbTest, queue_length=40)
    assert subscription.queue_length == 40
    task.thread.join(0.05)
    assert not task.done()
    publication.publish(OrbTest(val=4))
    assert task.result() is True
    assert subscription.copy().val == 4


WAYS: dict[str, Callable[[uorb.Subscription[Any]], object]] = {
    "wait": lambda subscription: subscription.wait(20.0),
    "poll": lambda subscription: uorb.poll([subscription], 20.0),
    "iteration": lambda subscription: next(iter(subscription)),
}


@pytest.mark.parametrize("what", ["subscription", "broker"])
@pytest.mark.parametrize("which", WAYS)
def test_closing_ends_the_waits(what: str, which: str, in_thread: InThread, runtime_dir: object) -> None:
    """A close in another thread ends a wait with ClosedError, at once."""
    with uorb.Broker() as broker, uorb.Broker.private() as second:
        for bus in (broker, second):
            subscription = bus.subscribe(OrbTest)
            task = in_thread(partial(WAYS[which], subscription))
            task.thread.join(0.25)
            assert not task.done()
            started = monotonic()
            (subscription if what == "subscription" else bus).close()
            with pytest.raises(uorb.ClosedError):
                task.result()
            assert monotonic() - started < 0.6


def test_closing_one_of_several_ends_the_poll(broker: uorb.Broker, in_thread: InThread) -> None:
    """A poll ends with ClosedError when any of its subscriptions is closed; the others are unharmed."""
    publication = broker.advertise(OrbTest)
    stays, goes = broker.subscribe(OrbTest), broker.subscribe("orb_multitest")
    task = in_thread(lambda: uorb.poll([stays, goes], 20.0))
    task.thread.join(0.1)
    goes.close()
    with pytest.raises(uorb.ClosedError):
        task.result()
    publication.publish(OrbTest(val=1))
    assert uorb.poll([stays], 5.0) == [stays]


def test_waiters_of_one_subscription_all_wake(broker: uorb.Broker, in_thread: InThread) -> None:
    """Eight threads sleep on one node; one publication wakes them all."""
    publication = broker.advertise(OrbTest)
    subscriptions = [broker.subscribe(OrbTest) for _ in range(4)] * 2
    tasks = [in_thread(lambda s=s: s.wait(20.0)) for s in subscriptions]  # type: ignore[misc]
    for task in tasks:
        task.thread.join(0.01)
    publication.publish(OrbTest())
    started = monotonic()
    assert all(task.result() is True for task in tasks)
    assert monotonic() - started < 1.5


def test_an_idle_wait_costs_no_processor_time(shared: uorb.Broker, script: Callable[..., Any]) -> None:
    """Three seconds in `wait`, under 1 % of a CPU."""
    shared.advertise(OrbTest, OrbTest())
    sleeper = script(
        """
import resource
sub = uorb.Broker().subscribe("orb_test", start="new")
sub.wait(0.01)
before = resource.getrusage(resource.RUSAGE_SELF)
sub.wait(3.0)
after = resource.getrusage(resource.RUSAGE_SELF)
say(after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime)
"""
    )
    assert float(sleeper.hear()) < 0.03


def test_a_withheld_sample_is_waited_for_without_spinning(broker: uorb.Broker) -> None:
    """While a sample is held back by the interval, the wait sleeps."""
    publication = broker.advertise(OrbTestMedium, OrbTestMedium())
    subscription = broker.subscribe(OrbTestMedium, interval=30.0)
    subscription.copy()
    subscription.copy()
    publication.publish(OrbTestMedium())
    before = resource.getrusage(resource.RUSAGE_THREAD)
    assert not subscription.wait(0.5)
    after = resource.getrusage(resource.RUSAGE_THREAD)
    assert after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime < 0.05
