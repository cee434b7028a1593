"""`fileno`, asyncio: a descriptor that is readable while an update is pending."""

import asyncio
import os
import select
from collections.abc import Callable
from time import monotonic
from typing import TYPE_CHECKING, Any

import pytest

import uorb_net as uorb
from uorb_net.msg import OrbTest, OrbTestMedium

if TYPE_CHECKING:
    from tests.conftest import Script

Eventually = Callable[..., bool]


def readable(subscription: uorb.Subscription[Any], seconds: float = 0.0) -> bool:
    """Tell whether the descriptor is readable."""
    return bool(select.select([subscription], [], [], seconds)[0])


def test_readable_exactly_while_check_is_true(broker: uorb.Broker) -> None:
    """After every publication and copy, for a queue too; level triggered."""
    publication = broker.advertise(OrbTestMedium)
    subscription = broker.subscribe(OrbTestMedium)
    assert not readable(subscription)
    for burst in (1, 3, 16, 40):
        for _ in range(burst):
            publication.publish(OrbTestMedium())
        while subscription.check():
            assert readable(subscription)
            assert readable(subscription)
            subscription.copy()
        assert not readable(subscription)
    publication.publish(OrbTestMedium())
    subscription.copy_with_info()
    assert not readable(subscription)


def test_readable_at_once_where_something_is_there(broker: uorb.Broker) -> None:
    """The first `fileno` tells of what came before it; it is the same descriptor every time."""
    broker.advertise(OrbTest, OrbTest())
    subscription = broker.subscribe(OrbTest)
    assert subscription.fileno() == subscription.fileno()
    assert readable(subscription)


def test_select_wakes_for_another_process(shared: uorb.Broker, script: Callable[..., "Script"]) -> None:
    """A publication elsewhere makes it readable while a select sleeps on it."""
    subscription = shared.subscribe(OrbTest)
    other = script(
        "pub = uorb.Broker().advertise('orb_test'); say('ready')\nfor line in sys.stdin: pub.publish(msg.OrbTest())"
    )
    other.hear()
    for _ in range(50):
        assert not readable(subscription)
        other.say("go")
        assert readable(subscription, 10.0)
        subscription.copy()


def test_a_withheld_sample_becomes_readable_when_due(broker: uorb.Broker) -> None:
    """Not before the interval has passed, and soon after, without another publication."""
    publication = broker.advertise(OrbTest)
    subscription = broker.subscribe(OrbTest, interval=0.25)
    subscription.fileno()
    for _ in range(2):
        publication.publish(OrbTest())
        subscription.copy()
        subscription.copy()
        copied = monotonic()
        publication.publish(OrbTest())
        assert not readable(subscription)
        assert readable(subscription, 5.0)
        assert 0.2 < monotonic() - copied < 1.0
        assert subscription.check()
        subscription.copy()
        subscription.copy()
    publication.publish(OrbTest())
    assert not readable(subscription)
    subscription.interval = 0.0
    assert readable(subscription)


def test_unadvertised_is_not_readable_for_long(broker: uorb.Broker, eventually: Eventually) -> None:
    """The descriptor follows `check` within a second or so when the last publisher leaves."""
    publication = broker.advertise(OrbTest, OrbTest())
    subscription = broker.subscribe(OrbTest)
    assert readable(subscription)
    publication.unadvertise()
    assert eventually(lambda: not readable(subscription), 2.5)


def test_a_killed_publisher_leaves_it_unreadable(
    shared: uorb.Broker, script: Callable[..., "Script"], eventually: Eventually
) -> None:
    """Death too shows within seconds, without a call."""
    other = script("pub = uorb.Broker().advertise('orb_test', msg.OrbTest()); say('ready'); hear()")
    other.hear()
    subscription = shared.subscribe(OrbTest)
    assert readable(subscription)
    other.kill()
    assert eventually(lambda: not readable(subscription), 2.5)


def test_the_descriptor_survives_a_replacement(shared: uorb.Broker, script: Callable[..., "Script"]) -> None:
    """A deeper publisher in another process: publications in the new file make it readable."""
    subscription = shared.subscribe(OrbTest)
    assert not readable(subscription)
    other = script(
        "pub = uorb.Broker().advertise('orb_test', queue_length=9); hear()\npub.publish(msg.OrbTest(val=5)); hear()"
    )
    other.say("go")
    assert readable(subscription, 10.0)
    while not subscription.check():
        assert readable(subscription, 10.0)
    assert subscription.copy().val == 5


def test_closing_closes_it(broker: uorb.Broker) -> None:
    """The descriptor belongs to the subscription; afterwards `fileno` raises ClosedError."""
    subscription = broker.subscribe(OrbTest)
    fd = subscription.fileno()
    os.fstat(fd)
    subscription.close()
    with pytest.raises(OSError, match="Bad file descriptor"):
        os.fstat(fd)
    with pytest.raises(uorb.ClosedError):
        subscription.fileno()


def test_iterating_in_an_event_loop(broker: uorb.Broker) -> None:
    """`async for` and `next` give every sample in turn; a timeout is None and loses nothing."""
    publication = broker.advertise(OrbTest, queue_length=16)
    subscription = broker.subscribe(OrbTest)

    async def publish() -> None:
        for value in range(20):
            publication.publish(OrbTest(val=value))
            await asyncio.sleep(0.001 * (value % 3))

    async def read() -> list[int]:
        assert await subscription.next(0.01) is None
        task = asyncio.create_task(publish())
        found = []
        async for message in subscription:
            found.append(message.val)
            if len(found) == 19:
                break
        last = await subscription.next()
        assert last is not None
        await task
        assert await subscription.next(0.01) is None
        return [*found, last.val]

    assert asyncio.run(read()) == list(range(20))
    assert subscription.lost == 0


def test_several_tasks_wait_in_one_loop(broker: uorb.Broker) -> None:
    """Each on a subscription of its own; cancelling one loses nothing for it or the others."""
    publication = broker.advertise(OrbTest)
    subscriptions = [broker.subscribe(OrbTest) for _ in range(3)]

    async def run() -> list[int]:
        tasks = [asyncio.create_task(subscription.next(10.0)) for subscription in subscriptions]
        await asyncio.sleep(0.02)
        tasks[0].cancel()
        await asyncio.gather(tasks[0], return_exceptions=True)
        publication.publish(OrbTest(val=8))
        found = [await task for task in tasks[1:]]
        found.append(await subscriptions[0].next(10.0))
        return [message.val for message in found if message is not None]

    assert asyncio.run(run()) == [8, 8, 8]


def test_a_wait_in_an_event_loop_ends_with_the_subscription(broker: uorb.Broker) -> None:
    """Closing it while a task waits raises ClosedError there, soon."""
    subscription = broker.subscribe(OrbTest)

    async def run() -> None:
        task = asyncio.create_task(subscription.next(10.0))
        await asyncio.sleep(0.02)
        subscription.close()
        with pytest.raises(uorb.ClosedError):
            await asyncio.wait_for(task, 2.0)

    asyncio.run(run())


def test_two_tasks_wait_on_one_subscription(broker: uorb.Broker) -> None:
    """Both go on: one gets the sample, the other the next."""
    publication = broker.advertise(OrbTest, queue_length=4)
    subscription = broker.subscribe(OrbTest)

    async def run() -> set[int]:
        tasks = [asyncio.create_task(subscription.next(5.0)) for _ in range(2)]
        await asyncio.sleep(0.02)
        for value in (1, 2):
            publication.publish(OrbTest(val=value))
            await asyncio.sleep(0.02)
        found = [await task for task in tasks]
        return {message.val for message in found if message is not None}

    started = monotonic()
    assert asyncio.run(run()) == {1, 2}
    assert monotonic() - started < 2.0


def test_a_task_that_waits_out_an_interval(broker: uorb.Broker) -> None:
    """A sample held back reaches the loop when it is due."""
    publication = broker.advertise(OrbTest, OrbTest(val=1))
    subscription = broker.subscribe(OrbTest, interval=0.2)
    subscription.copy()
    subscription.copy()
    publication.publish(OrbTest(val=2))

    async def run() -> float:
        started = monotonic()
        message = await subscription.next(5.0)
        assert message is not None
        assert message.val == 2
        return monotonic() - started

    assert 0.1 < asyncio.run(run()) < 1.0
