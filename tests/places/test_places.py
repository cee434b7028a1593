"""One suite, several places: a subscriber cannot tell whether the publisher is a thread, a process or a host away.

What the network cannot give is visibility when `publish` returns; `place.eventually` stands for that, and is
immediate everywhere else. Losses of a queue and of the network are counted apart; their sum is the same.
"""

import asyncio
import select
from time import monotonic
from typing import Any

import pytest

import uorb_net as uorb

TOPIC = "orb_test"


def val(*numbers: int) -> list[dict[str, Any]]:
    return [{"val": number} for number in numbers]


def drain(subscription: Any, count: int) -> list[int]:
    """Copy `count` samples, waiting for each."""
    got: list[int] = []
    while len(got) < count and subscription.wait(5.0):
        got.append(subscription.copy().val)
    return got


def test_subscribing_comes_first(place: Any) -> None:
    """No data before, no update from the advertisement alone, then the sample."""
    subscription = place.broker.subscribe(TOPIC)
    assert not subscription.check()
    assert not subscription.advertised
    assert subscription.stat() == 0
    with pytest.raises(uorb.NoDataError):
        subscription.copy()
    publisher = place.advertise(TOPIC)
    assert subscription.advertised
    assert not subscription.wait(0.05)
    before = uorb.hrt_absolute_time()
    publisher.publish(*val(7))
    assert subscription.wait(5.0)
    assert subscription.check(), "check has no side effect"
    assert subscription.copy().val == 7
    assert not subscription.check()
    assert subscription.copy().val == 7, "the newest again"
    assert before <= subscription.stat() <= uorb.hrt_absolute_time()


def test_a_stamp_of_zero_is_filled_in_and_any_other_left_alone(place: Any) -> None:
    """The publisher's timestamp is never rewritten on the way."""
    subscription = place.broker.subscribe(TOPIC)
    publisher = place.advertise(TOPIC, queue_length=2)
    publisher.publish({"val": 1}, {"val": 2, "timestamp": 12345})
    stamped, given = drain_messages(subscription, 2)
    assert abs(stamped.timestamp - uorb.hrt_absolute_time()) < 10_000_000
    assert given.timestamp == 12345


def drain_messages(subscription: Any, count: int) -> list[Any]:
    got: list[Any] = []
    while len(got) < count and subscription.wait(5.0):
        got.append(subscription.copy())
    return got


def test_a_late_subscriber_starts_where_it_asked_to(place: Any) -> None:
    """latest: the newest counts as an update; new: it can be copied and does not."""
    publisher = place.advertise(TOPIC)
    publisher.publish(*val(1, 2))
    latest = place.broker.subscribe(TOPIC)
    new = place.broker.subscribe(TOPIC, start="new")
    assert latest.wait(5.0)
    assert latest.copy().val == 2
    assert latest.lost == 0, "what was before the subscription is not lost"
    assert not new.wait(0.05)
    assert new.copy().val == 2
    publisher.publish(*val(3))
    assert drain(new, 1) == [3]
    assert drain(latest, 1) == [3]


def test_a_queue_is_read_in_order_and_overruns_are_counted(place: Any) -> None:
    """Forty writes into a queue of 16: the last 16 in order, 24 lost, then the newest for ever."""
    subscription = place.broker.subscribe(TOPIC)
    publisher = place.advertise(TOPIC, queue_length=16)
    publisher.publish(*val(*range(40)))
    assert place.eventually(lambda: place.broker.topics()[0].generation + place.lost() == 40)
    assert subscription.queue_length == 16
    assert subscription.pending == 16
    assert drain(subscription, 16) == list(range(24, 40))
    assert subscription.lost + place.lost() == 24
    assert not subscription.check()
    assert subscription.copy().val == 39
    assert subscription.generation + place.lost() == 40


def test_what_a_reader_of_one_sample_misses_is_counted(place: Any) -> None:
    """Four publications, one copy: three lost, by the topic or on the way."""
    subscription = place.broker.subscribe(TOPIC)
    publisher = place.advertise(TOPIC)
    publisher.publish(*val(1, 2, 3, 4))
    assert place.eventually(lambda: place.broker.topics()[0].generation + place.lost() == 4)
    assert subscription.copy().val == 4
    assert subscription.lost + place.lost() == 3


def test_info_tells_number_times_and_origin(place: Any) -> None:
    """Numbers count from 1; times are of this host's clock."""
    subscription = place.broker.subscribe(TOPIC)
    publisher = place.advertise(TOPIC, queue_length=4)
    before = uorb.hrt_absolute_time()
    publisher.publish(*val(5, 6))
    for number in (1, 2):
        assert subscription.wait(5.0)
        sample = subscription.copy_with_info()
        info = sample.info
        assert sample.message.val == 4 + number
        assert (info.generation, info.sequence, info.latched) == (number, number, False)
        assert before - 5000 <= info.published_us <= info.received_us <= uorb.hrt_absolute_time()
        assert info.origin == ("far" if place.remote else place.broker.host)


def test_an_interval_gives_the_newest_and_wakes_when_due(place: Any) -> None:
    """A limited reader of a burst: its first sample, then its last when the interval has passed; none is lost."""
    publisher = place.advertise(TOPIC, queue_length=64)
    subscription = place.broker.subscribe(TOPIC, interval=0.3)
    publisher.publish(*val(0))
    assert drain(subscription, 1) == [0]
    publisher.publish(*val(1))
    assert drain(subscription, 1) == [1]
    began = monotonic()
    publisher.publish(*val(*range(2, 40)))
    got = drain(subscription, 1)
    while got[-1] != 39:
        got += drain(subscription, 1)
    assert len(got) <= 3
    assert monotonic() - began < 2.0
    assert subscription.lost == 0
    assert place.lost() == 0


def test_unadvertising_is_seen_and_the_old_sample_stays_away(place: Any) -> None:
    """No update, no copy; advertised again there is nothing until something new is published."""
    publisher = place.advertise(TOPIC)
    publisher.publish(*val(1))
    subscription = place.broker.subscribe(TOPIC)
    assert drain(subscription, 1) == [1]
    publisher.unadvertise()
    assert place.eventually(lambda: not place.broker.exists(TOPIC))
    assert not subscription.check()
    with pytest.raises(uorb.NoDataError):
        subscription.copy()
    publisher = place.advertise(TOPIC)
    assert not subscription.wait(0.05)
    with pytest.raises(uorb.NoDataError):
        subscription.copy()
    publisher.publish(*val(2))
    assert drain(subscription, 1) == [2]
    assert subscription.lost == 0


def test_one_of_two_publishers_leaves_the_topic_to_the_other(place: Any) -> None:
    """Unadvertising is counted."""
    subscription = place.broker.subscribe(TOPIC)
    first, second = place.advertise(TOPIC, queue_length=4), place.advertise(TOPIC)
    first.publish(*val(1))
    second.publish(*val(2))
    assert drain(subscription, 2) == [1, 2]
    first.unadvertise()
    second.publish(*val(3))
    assert drain(subscription, 1) == [3]
    assert place.broker.exists(TOPIC)


def test_instances_are_apart(place: Any) -> None:
    """Own data, own priority, own updates; a hole hides nothing; the lowest number is taken again."""
    publishers = [place.advertise(TOPIC, multi=True, priority=50 + n) for n in range(3)]
    assert [publisher.instance for publisher in publishers] == [0, 1, 2]
    for number, publisher in enumerate(publishers):
        publisher.publish(*val(10 + number))
    readers = [place.broker.subscribe(TOPIC, number) for number in range(3)]
    for number, reader in enumerate(readers):
        assert drain(reader, 1) == [10 + number]
        assert reader.priority == 50 + number
    publishers[1].publish(*val(99))
    assert drain(readers[1], 1) == [99]
    assert not readers[0].check()
    assert not readers[2].check()
    publishers[1].unadvertise()
    assert place.eventually(lambda: place.broker.group_count(TOPIC) == 2)
    assert not place.broker.exists(TOPIC, 1)
    assert place.broker.exists(TOPIC, 2)
    assert place.advertise(TOPIC, multi=True).instance == 1


def test_poll_is_level_triggered_over_several_topics(place: Any) -> None:
    """What has an update is returned until it is copied, in the order given."""
    one, two = place.broker.subscribe(TOPIC), place.broker.subscribe("orb_multitest")
    publishers = [place.advertise(TOPIC), place.advertise("orb_multitest")]
    assert uorb.poll([one, two], 0.02) == []
    publishers[1].publish(*val(2))
    assert uorb.poll([one, two], 5.0) == [two]
    assert uorb.poll([two, one], 0) == [two]
    publishers[0].publish(*val(1))
    assert one.wait(5.0)
    assert uorb.poll([two, one], 0) == [two, one]
    two.copy()
    assert uorb.poll([two, one], 0) == [one]


def test_iteration_descriptor_and_asyncio(place: Any) -> None:
    """Each unread sample in turn, three ways."""
    subscription = place.broker.subscribe(TOPIC)
    publisher = place.advertise(TOPIC, queue_length=8)
    publisher.publish(*val(1, 2))
    got = []
    for message in subscription:
        got.append(message.val)
        if len(got) == 2:
            break
    assert got == [1, 2]
    assert select.select([subscription], [], [], 0.02)[0] == []
    publisher.publish(*val(3))
    assert select.select([subscription], [], [], 5.0)[0] == [subscription]
    assert drain(subscription, 1) == [3]
    publisher.publish(*val(4, 5))

    async def read() -> list[int]:
        first = await subscription.next(5.0)
        assert first is not None
        async for message in subscription:
            return [first.val, message.val]
        return []

    assert asyncio.run(read()) == [4, 5]
    assert asyncio.run(subscription.next(0.02)) is None


def test_a_killed_publisher_is_unadvertised(place: Any) -> None:
    """Within 1 s, and the subscription goes on with the next publisher."""
    if not hasattr(place, "process"):
        pytest.skip("a thread cannot be killed")
    publisher = place.advertise(TOPIC)
    publisher.publish(*val(1))
    subscription = place.broker.subscribe(TOPIC)
    assert drain(subscription, 1) == [1]
    place.kill()
    began = monotonic()
    while place.broker.exists(TOPIC) or subscription.advertised:
        assert monotonic() - began < 1.0
    with pytest.raises(uorb.NoDataError):
        subscription.copy()
    with place.broker.advertise(TOPIC) as own:
        own.publish(uorb.msg.OrbTest(val=2))
        assert drain(subscription, 1) == [2]


def test_a_topic_keeps_its_publishers_queue_length(place: Any) -> None:
    """The first publisher's choice holds; a subscriber that came first follows."""
    subscription = place.broker.subscribe(TOPIC)
    assert subscription.queue_length == 1
    publisher = place.advertise(TOPIC, queue_length=100)
    publisher.publish(*val(*range(100)))
    assert drain(subscription, 100) == list(range(100))
    assert subscription.queue_length == 100
    assert subscription.lost == 0
