"""Advertising: instances, counting, re-advertising, queue lengths, priorities."""

from typing import Any

import pytest

import uorb_net as uorb
from uorb_net.msg import OrbTest, OrbTestMedium

TOPIC = "orb_multitest"


def values(subscription: uorb.Subscription[Any]) -> list[int]:
    """Return the values of all updates."""
    return [m.val for m in iter(subscription.update, None)]


# -- instances ------------------------------------------------------------------------------------


def test_multi_takes_the_lowest_free_and_ends_at_ten(broker: uorb.Broker) -> None:
    """Instances 0..9 in order; the eleventh is InstanceError (EIO) and harms none; a freed number is reused."""
    publications = [broker.advertise_multi(TOPIC) for _ in range(10)]
    assert [publication.instance for publication in publications] == list(range(10))
    with pytest.raises(uorb.InstanceError) as caught:
        broker.advertise_multi(TOPIC)
    assert caught.value.errno == 5
    assert broker.group_count(TOPIC) == 10
    for publication in publications:
        publication.publish(OrbTest(val=publication.instance))
    assert [broker.subscribe(TOPIC, n).copy().val for n in range(10)] == list(range(10))
    for gone in (7, 3):
        publications[gone].unadvertise()
    assert [broker.advertise_multi(TOPIC).instance for _ in range(2)] == [3, 7]


def test_group_count_counts_across_holes(broker: uorb.Broker) -> None:
    """A hole hides nothing."""
    publications = [broker.advertise_multi(TOPIC) for _ in range(5)]
    for gone in (0, 2, 3):
        publications[gone].unadvertise()
    assert broker.group_count(TOPIC) == 2
    assert [broker.exists(TOPIC, n) for n in range(6)] == [False, True, False, False, True, False]


def test_a_node_of_subscribers_only_is_free(broker: uorb.Broker) -> None:
    """Subscribing makes a node but advertises nothing."""
    subscription = broker.subscribe(TOPIC, 0)
    assert not broker.exists(TOPIC)
    assert broker.group_count(TOPIC) == 0
    found = [subscription.advertised]
    publication = broker.advertise_multi(TOPIC)
    assert publication.instance == 0
    assert [*found, subscription.advertised] == [False, True]
    publication.publish(OrbTest(val=1))
    assert subscription.copy().val == 1


def test_a_free_instance_is_found_free_after_the_node_was_replaced(shared: uorb.Broker, script: Any) -> None:
    """A process that knows instance 0 by its old buffer does not take it from the one that replaced it."""
    subscription = shared.subscribe(TOPIC, 0)
    other = script("pub = uorb.Broker().advertise_multi('orb_multitest', queue_length=8); say(pub.instance); hear()")
    assert other.hear() == "0"
    assert shared.advertise_multi(TOPIC).instance == 1
    assert subscription.queue_length == 8


def test_instances_out_of_range(broker: uorb.Broker) -> None:
    """`subscribe` raises InstanceError (EIO), `exists` is False."""
    for instance in (-1, 10, 1000):
        assert not broker.exists(TOPIC, instance)
        with pytest.raises(uorb.InstanceError) as caught:
            broker.subscribe(TOPIC, instance)
        assert caught.value.errno == 5


def test_instances_are_apart(broker: uorb.Broker) -> None:
    """A publication on one instance shows on no other."""
    publications = [broker.advertise_multi(TOPIC) for _ in range(3)]
    subscriptions = [broker.subscribe(TOPIC, n) for n in range(3)]
    publications[1].publish(OrbTest(val=5))
    assert [subscription.check() for subscription in subscriptions] == [False, True, False]


def test_advertise_joins_instance_zero(broker: uorb.Broker) -> None:
    """`advertise` always means instance 0, also where `advertise_multi` made it."""
    first = broker.advertise_multi(TOPIC)
    second = broker.advertise(TOPIC)
    subscription = broker.subscribe(TOPIC)
    assert second.instance == 0
    first.publish(OrbTest(val=1))
    assert subscription.copy().val == 1
    second.publish(OrbTest(val=2))
    assert subscription.copy().val == 2
    assert broker.group_count(TOPIC) == 1
    assert broker.topics()[0].publishers == 2


# -- unadvertise ----------------------------------------------------------------------------------


def test_unadvertise_is_counted(broker: uorb.Broker) -> None:
    """The topic stays while one publisher lives; then it is gone for exists, check and copy."""
    first, second = broker.advertise(OrbTest), broker.advertise(OrbTest)
    subscription = broker.subscribe(OrbTest)
    first.publish(OrbTest(val=1))
    first.unadvertise()
    first.unadvertise()  # does nothing
    assert broker.exists(OrbTest)
    assert subscription.check()
    second.publish(OrbTest(val=2))
    second.unadvertise()
    assert not broker.exists(OrbTest)
    assert not subscription.advertised
    assert not subscription.check()
    assert subscription.pending == 0
    assert subscription.update() is None
    with pytest.raises(uorb.NoDataError) as caught:
        subscription.copy()
    assert caught.value.errno == 5
    with pytest.raises(uorb.NoDataError):
        subscription.copy_with_info()


def test_unadvertised_between_check_and_copy(broker: uorb.Broker, monkeypatch: pytest.MonkeyPatch) -> None:
    """`update` is None then, and iteration waits on: only `copy` tells of it by an exception."""
    publication = broker.advertise(OrbTest, OrbTest())
    subscription = broker.subscribe(OrbTest)

    def check(_: object) -> bool:
        publication.unadvertise()
        return True

    monkeypatch.setattr(uorb.Subscription, "check", check)
    assert subscription.update() is None


def test_publishing_after_unadvertise(broker: uorb.Broker) -> None:
    """The publication is spent: ClosedError (EBADF), also where another keeps the topic."""
    spent = broker.advertise(OrbTest)
    other = broker.advertise(OrbTest)
    spent.close()
    with pytest.raises(uorb.ClosedError) as caught:
        spent.publish(OrbTest())
    assert caught.value.errno == 9
    with pytest.raises(uorb.ClosedError):
        spent.publish_encoded(bytes(OrbTest.__uorb__.payload_length))
    other.publish(OrbTest())
    assert broker.topics()[0].generation == 1


def test_leaving_the_context_unadvertises(broker: uorb.Broker) -> None:
    """Publications and subscriptions are context managers."""
    with broker.advertise(OrbTest), broker.subscribe(OrbTest) as subscription:
        assert broker.exists(OrbTest)
    assert not broker.exists(OrbTest)
    with pytest.raises(uorb.ClosedError):
        subscription.check()


@pytest.mark.parametrize("depth", [1, 4])
def test_advertising_again_brings_nothing_back(broker: uorb.Broker, depth: int) -> None:
    """Old samples are no updates, not retained, not copied; positions and counters go on; nothing is lost."""
    publication = broker.advertise(OrbTest, queue_length=depth)
    subscription = broker.subscribe(OrbTest)
    for value in range(3):
        publication.publish(OrbTest(val=value))
    publication.unadvertise()
    again = broker.advertise(OrbTest, queue_length=depth)
    assert broker.exists(OrbTest)
    readers = [subscription, *(broker.subscribe(OrbTest, start=start) for start in ("latest", "new", "oldest"))]
    for reader in readers:
        assert (reader.check(), reader.pending) == (False, 0)
        with pytest.raises(uorb.NoDataError):
            reader.copy()
    again.publish(OrbTest(val=10))
    assert [values(reader) for reader in readers] == [[10]] * 4
    assert [reader.lost for reader in readers] == [0] * 4
    assert [reader.generation for reader in readers] == [4] * 4
    assert broker.topics()[0].generation == 4


def test_overruns_after_advertising_again_are_lost(broker: uorb.Broker) -> None:
    """What the new advertisement overwrites counts, what the old one left does not."""
    publication = broker.advertise(OrbTest)
    subscription = broker.subscribe(OrbTest)
    publication.publish(OrbTest())
    publication.publish(OrbTest())
    publication.unadvertise()
    again = broker.advertise(OrbTest)
    for value in range(4):
        again.publish(OrbTest(val=value))
    assert subscription.copy().val == 3
    assert subscription.lost == 3


def test_advertised_without_data(broker: uorb.Broker) -> None:
    """The topic exists; check is false and copy raises until the first publication."""
    publication = broker.advertise(OrbTest)
    subscription = broker.subscribe(OrbTest)
    assert broker.exists("orb_test")
    assert subscription.advertised
    assert not subscription.check()
    with pytest.raises(uorb.NoDataError):
        subscription.copy()
    publication.publish(OrbTest())
    assert subscription.check()


# -- queue length ---------------------------------------------------------------------------------


@pytest.mark.parametrize("depth", [0, -1, 256, 1000])
def test_queue_lengths_out_of_range(broker: uorb.Broker, depth: int) -> None:
    """1..255; anything else is a ValueError that is a UorbError (EINVAL) too, and advertises nothing."""
    for advertise in (broker.advertise, broker.advertise_multi):
        with pytest.raises(ValueError, match=r"1\.\.255") as caught:
            advertise(OrbTest, queue_length=depth)
        assert isinstance(caught.value, uorb.UorbError)
        assert caught.value.errno == 22
    assert not broker.exists(OrbTest)


@pytest.mark.parametrize("depth", [1, 2, 3, 5, 100, 254, 255])
def test_queue_lengths_are_not_rounded(broker: uorb.Broker, depth: int) -> None:
    """Exactly what was asked for is readable."""
    publication = broker.advertise(OrbTest, queue_length=depth)
    subscription = broker.subscribe(OrbTest)
    for value in range(600):
        publication.publish(OrbTest(val=value))
    assert publication.queue_length == subscription.queue_length == subscription.pending == depth
    assert values(subscription) == list(range(600 - depth, 600))
    assert broker.topics()[0].queue_length == depth


def test_source_of_the_queue_length(broker: uorb.Broker) -> None:
    """Explicit before ORB_QUEUE_LENGTH before 1."""
    assert broker.advertise(OrbTest).queue_length == 1
    assert broker.advertise(OrbTestMedium).queue_length == 16
    assert broker.advertise("orb_test_medium_multi", queue_length=5).queue_length == 5
    assert broker.subscribe("orb_test_medium_queue").queue_length == 16


def test_the_first_choice_holds_while_there_is_data(broker: uorb.Broker) -> None:
    """A later, different wish is no error; `queue_length` tells what is in force."""
    first = broker.advertise(OrbTest, queue_length=4)
    first.publish(OrbTest())
    second = broker.advertise(OrbTest, queue_length=9)
    assert (first.queue_length, second.queue_length) == (4, 4)
    first.unadvertise()
    assert broker.advertise(OrbTest, queue_length=9).queue_length == 4
    assert broker.subscribe(OrbTest).queue_length == 4


def test_a_new_choice_applies_while_there_is_no_data(broker: uorb.Broker) -> None:
    """Also to a node made by a subscriber, and after everybody left; without a wish nothing changes."""
    subscription = broker.subscribe(OrbTest)
    assert subscription.queue_length == 1
    first = broker.advertise(OrbTest, queue_length=3)
    second = broker.advertise(OrbTest, queue_length=40)
    third = broker.advertise(OrbTest)
    assert {p.queue_length for p in (first, second, third)} == {40}
    assert subscription.queue_length == 40
    second.publish(OrbTest(val=1))
    for publication in (first, second, third):
        publication.unadvertise()
    again = broker.advertise(OrbTest, queue_length=2)
    assert again.queue_length == subscription.queue_length == 2
    again.publish(OrbTest(val=2))
    assert values(subscription) == [2]


def test_positions_survive_another_queue_length(broker: uorb.Broker) -> None:
    """Generations go on over a replaced ring, and the reader's counters with them."""
    publication = broker.advertise(OrbTest, queue_length=2)
    subscription = broker.subscribe(OrbTest)
    for value in range(5):
        publication.publish(OrbTest(val=value))
    assert values(subscription) == [3, 4]
    publication.unadvertise()
    again = broker.advertise(OrbTest, queue_length=255)
    for value in range(300):
        again.publish(OrbTest(val=value))
    assert values(subscription) == list(range(45, 300))
    assert subscription.lost == 3 + 45
    assert subscription.generation == 305
    assert subscription.copy_with_info().info.generation == 305


# -- priority -------------------------------------------------------------------------------------


def test_priorities(broker: uorb.Broker) -> None:
    """75 unless given, read live; claiming an instance anew replaces it."""
    subscription = broker.subscribe(TOPIC)
    assert subscription.priority == 75
    publication = broker.advertise_multi(TOPIC, priority=uorb.Priority.HIGH)
    assert publication.priority == subscription.priority == 100
    broker.advertise(TOPIC)
    assert subscription.priority == 100
    assert broker.topics()[0].priority == 100
    second = broker.advertise_multi(TOPIC, priority=uorb.Priority.MAX)
    assert broker.subscribe(TOPIC, 1).priority == 255
    second.unadvertise()
    assert broker.advertise_multi(TOPIC, priority=1).instance == 1
    assert broker.subscribe(TOPIC, 1).priority == 1


def test_priority_names() -> None:
    """MIN 1, VERY_LOW 25, LOW 50, DEFAULT 75, HIGH 100, VERY_HIGH 125, MAX 255."""
    assert [p.value for p in uorb.Priority] == [1, 25, 50, 75, 100, 125, 255]


@pytest.mark.parametrize("priority", [0, -5, 256])
def test_priorities_out_of_range(broker: uorb.Broker, priority: int) -> None:
    """1..255; anything else is a ValueError and advertises nothing."""
    with pytest.raises(ValueError, match="priority"):
        broker.advertise_multi(OrbTest, priority=priority)
    assert broker.topics() == []
