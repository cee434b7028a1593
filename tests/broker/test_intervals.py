"""Intervals: due times to the microsecond on a clock of the test's own, and waking when due on the real one."""

from collections.abc import Callable
from time import monotonic
from typing import Any

import pytest

import uorb_net as uorb
from uorb_net import subscription as subscription_module
from uorb_net.msg import OrbTest, OrbTestMedium


class Clock:
    """Stands in for `monotonic` in the subscriptions."""

    def __init__(self) -> None:
        self.now = 1000.0

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    """A clock that moves only when told."""
    clock = Clock()
    monkeypatch.setattr(subscription_module, "monotonic", clock)
    return clock


def test_first_at_once_then_one_per_interval(broker: uorb.Broker, clock: Clock) -> None:
    """`last` is 0 at first, so the first sample is due; in the long run each takes an interval."""
    publication = broker.advertise(OrbTest)
    subscription = broker.subscribe(OrbTest, interval=0.5)
    publication.publish(OrbTest(val=1))
    assert subscription.check()
    subscription.copy()
    subscription.copy()  # uses up the credit of the time before
    publication.publish(OrbTest(val=2))
    assert not subscription.check()
    clock.now += 0.499
    assert not subscription.check()
    clock.now += 0.002
    assert subscription.check()
    assert subscription.copy().val == 2


def test_lateness_is_credited_up_to_one_interval(broker: uorb.Broker, clock: Clock) -> None:
    """After a copy `last` becomes clamp(last + I, now - I, now): late by less than I keeps the grid."""
    publication = broker.advertise(OrbTest)
    subscription = broker.subscribe(OrbTest, interval=1.0)
    publication.publish(OrbTest())
    subscription.copy()  # last: 999 = clamp(0 + 1, 999, 1000)
    publication.publish(OrbTest())
    assert subscription.check()  # so a second may follow at once: PX4's rule
    subscription.copy()  # last: 1000
    publication.publish(OrbTest())
    assert not subscription.check()
    clock.now = 1001.4
    assert subscription.check()
    subscription.copy()  # last: 1001, 0.4 late
    publication.publish(OrbTest())
    clock.now = 1001.9
    assert not subscription.check()
    clock.now = 1002.0
    assert subscription.check()
    clock.now = 1010.0
    subscription.copy()  # last: 1009
    publication.publish(OrbTest())
    assert subscription.check()
    subscription.copy()  # last: 1010
    publication.publish(OrbTest())
    assert not subscription.check()


def test_long_run_rate_is_one_per_interval(broker: uorb.Broker, clock: Clock) -> None:
    """250 Hz through an interval of 10 ms: 100 a second, in spite of 4 ms steps."""
    publication = broker.advertise(OrbTest)
    subscription = broker.subscribe(OrbTest, interval=0.01)
    delivered = 0
    for _ in range(2500):
        publication.publish(OrbTest())
        delivered += subscription.update() is not None
        clock.now += 0.004
    assert 990 <= delivered <= 1003


def test_an_unconditional_copy_counts_for_the_interval(broker: uorb.Broker, clock: Clock) -> None:
    """`copy` delivers whatever the interval says, and steps `last` like any other."""
    publication = broker.advertise(OrbTest)
    subscription = broker.subscribe(OrbTest, interval=1.0)
    publication.publish(OrbTest(val=1))
    subscription.copy()
    subscription.copy()  # last: 1000
    publication.publish(OrbTest(val=2))
    assert not subscription.check()
    assert subscription.copy().val == 2
    publication.publish(OrbTest(val=3))
    assert not subscription.check()
    assert subscription.update() is None


def test_limited_reader_of_a_queue_gets_the_newest(broker: uorb.Broker, clock: Clock) -> None:
    """The newest is delivered, the others skipped: in no loss figure."""
    publication = broker.advertise(OrbTestMedium)
    subscription = broker.subscribe(OrbTestMedium, interval=1.0)
    for value in range(5):
        publication.publish(OrbTestMedium(val=value))
    assert subscription.copy().val == 4
    assert (subscription.lost, subscription.pending, subscription.generation) == (0, 0, 5)
    for value in range(5, 105):
        publication.publish(OrbTestMedium(val=value))
    clock.now += 5.0
    assert subscription.copy_with_info().message.val == 104
    assert subscription.lost == 0
    assert broker.topics()[0].lost == 0


def test_lifting_the_interval_keeps_last_and_frees_at_once(broker: uorb.Broker, clock: Clock) -> None:
    """Setting the interval keeps `last`; setting 0 makes a withheld sample an update at once."""
    publication = broker.advertise(OrbTest)
    subscription = broker.subscribe(OrbTest, interval=10.0)
    assert subscription.interval == 10.0
    publication.publish(OrbTest())
    subscription.copy()
    subscription.copy()  # last: 1000
    publication.publish(OrbTest())
    clock.now += 2.0
    assert not subscription.check()
    subscription.interval = 1.5
    assert subscription.check()
    subscription.interval = 3.0
    assert not subscription.check()
    subscription.interval = 0.0
    assert subscription.check()


@pytest.mark.parametrize("interval", [-0.1, float("nan")])
def test_a_negative_interval_is_refused(broker: uorb.Broker, interval: float) -> None:
    """An interval is seconds, 0 or more; a refused one leaves nothing behind."""
    with pytest.raises(ValueError, match="interval"):
        broker.subscribe(OrbTest, interval=interval)
    subscription = broker.subscribe(OrbTest)
    with pytest.raises(ValueError, match="interval"):
        subscription.interval = interval
    assert subscription.interval == 0.0
    subscription.close()
    assert not broker._directory.nodes


def test_wait_wakes_when_a_withheld_sample_is_due(broker: uorb.Broker) -> None:
    """No further publication is needed: `wait` and `poll` return at `last + I`, neither early nor late."""
    publication = broker.advertise(OrbTest)
    subscription = broker.subscribe(OrbTest, interval=0.2)
    other = broker.subscribe("orb_multitest")
    publication.publish(OrbTest(val=1))
    subscription.copy()
    subscription.copy()
    waits: list[Callable[[], Any]] = [
        lambda: subscription.wait(5.0),
        lambda: uorb.poll([other, subscription], 5.0) == [subscription],
    ]
    for value, wait in enumerate(waits):
        publication.publish(OrbTest(val=value))
        started = monotonic()
        assert not subscription.check()
        assert wait()
        assert monotonic() - started < 1.0
        assert subscription.copy().val == value
        subscription.copy()


def test_wait_does_not_return_before_the_interval(broker: uorb.Broker) -> None:
    """A withheld sample ends no wait early."""
    publication = broker.advertise(OrbTest, OrbTest())
    subscription = broker.subscribe(OrbTest, interval=30.0)
    subscription.copy()
    subscription.copy()
    publication.publish(OrbTest())
    assert not subscription.wait(0.1)
    assert uorb.poll([subscription], 0.1) == []


def test_lifting_the_interval_wakes_a_waiter(broker: uorb.Broker, in_thread: Callable[..., Any]) -> None:
    """A wait that a withheld sample could not end ends when another thread sets the interval to 0."""
    publication = broker.advertise(OrbTest, OrbTest())
    subscription = broker.subscribe(OrbTest, interval=600.0)
    subscription.copy()
    subscription.copy()
    publication.publish(OrbTest())
    task = in_thread(lambda: subscription.wait(20.0))
    assert not task.thread.join(0.2)
    assert not task.done()
    started = monotonic()
    subscription.interval = 0.0
    assert task.result() is True
    assert monotonic() - started < 0.5


def test_the_fastest_interval_of_a_process_is_known_to_the_node(broker: uorb.Broker) -> None:
    """Intervals of two subscriptions do not disturb each other."""
    publication = broker.advertise(OrbTest)
    slow, fast = broker.subscribe(OrbTest, interval=600.0), broker.subscribe(OrbTest)
    publication.publish(OrbTest())
    for subscription in (slow, fast):
        subscription.copy()
        subscription.copy()
    publication.publish(OrbTest())
    assert not slow.check()
    assert fast.check()
