"""Generation arithmetic: what is pending, delivered and lost; where a subscription starts."""

import pytest

import uorb_net as uorb
from uorb_net.broker.layout import W_FLOOR, W_G
from uorb_net.msg import OrbTest, OrbTestMedium

QUEUE = 16  # ORB_QUEUE_LENGTH of OrbTestMedium


def publish(publication: uorb.Publication[OrbTest], *values: int) -> None:
    """Publish several values."""
    for value in values:
        publication.publish(OrbTest(val=value))


def drain(subscription: uorb.Subscription[OrbTest]) -> list[int]:
    """Return the values of all updates."""
    return [m.val for m in iter(subscription.update, None)]


def test_forty_writes_into_sixteen(broker: uorb.Broker) -> None:
    """Queue 16, reader at 0, 40 writes: #24 with 24 lost, then #25 ... #39, then #39 for ever."""
    publication = broker.advertise(OrbTestMedium)
    subscription = broker.subscribe(OrbTestMedium)
    assert publication.queue_length == subscription.queue_length == QUEUE
    for value in range(40):
        publication.publish(OrbTestMedium(val=value))
    assert (subscription.pending, subscription.lost, subscription.generation) == (16, 0, 0)
    assert subscription.copy().val == 24
    assert (subscription.lost, subscription.generation, subscription.pending) == (24, 25, 15)
    assert [subscription.copy().val for _ in range(15)] == list(range(25, 40))
    assert not subscription.check()
    assert [subscription.copy().val for _ in range(3)] == [39, 39, 39]
    assert (subscription.lost, subscription.generation, subscription.pending) == (24, 40, 0)


def test_one_deep_delivers_the_newest_and_counts_the_rest(broker: uorb.Broker) -> None:
    """Four publications, one copy: the last, three lost, nothing pending."""
    publication = broker.advertise(OrbTest)
    subscription = broker.subscribe(OrbTest)
    publish(publication, 1, 2, 3, 4)
    assert subscription.pending == 1
    assert subscription.copy().val == 4
    assert (subscription.lost, subscription.pending, subscription.generation) == (3, 0, 4)
    assert subscription.copy().val == 4
    assert subscription.lost == 3


@pytest.mark.parametrize("depth", [1, 2, 3, 7, 16, 255])
@pytest.mark.parametrize("writes", [1, 2, 3, 8, 17, 300])
def test_lost_plus_delivered_is_written(broker: uorb.Broker, depth: int, writes: int) -> None:
    """Any depth, any number of writes: the newest min(depth, writes), the rest lost, in order."""
    publication = broker.advertise(OrbTest, queue_length=depth)
    subscription = broker.subscribe(OrbTest)
    publish(publication, *range(writes))
    kept = min(depth, writes)
    assert subscription.pending == kept
    assert drain(subscription) == list(range(writes - kept, writes))
    assert subscription.lost == writes - kept
    assert subscription.generation == writes


@pytest.mark.parametrize("depth", [1, 4])
def test_the_ring_wraps_many_times(broker: uorb.Broker, depth: int) -> None:
    """A reader that keeps up sees every sample of a thousand, whatever the ring's size."""
    publication = broker.advertise(OrbTest, queue_length=depth)
    subscription = broker.subscribe(OrbTest)
    for value in range(1000):
        publish(publication, value)
        assert drain(subscription) == [value]
    assert subscription.lost == 0


def test_readers_have_positions_of_their_own(broker: uorb.Broker) -> None:
    """One reader's copies change nothing for another; two that miss one sample lose two together."""
    publication = broker.advertise(OrbTest, queue_length=2)
    first, second = broker.subscribe(OrbTest), broker.subscribe(OrbTest)
    publish(publication, 1, 2)
    assert drain(first) == [1, 2]
    assert second.check()
    assert second.pending == 2
    publish(publication, 3, 4, 5)
    assert drain(second) == [4, 5]
    assert drain(first) == [4, 5]
    assert (first.lost, second.lost) == (1, 3)
    [status] = broker.topics()
    assert status.lost == 4


def test_lost_of_a_closed_reader_stays_in_the_sum(broker: uorb.Broker) -> None:
    """The node's loss counts past subscriptions too; a reader that never copies adds nothing."""
    publication = broker.advertise(OrbTest)
    broker.subscribe(OrbTest)
    with broker.subscribe(OrbTest) as reader:
        publish(publication, 1, 2, 3)
        reader.copy()
        assert broker.topics()[0].lost == 2
    assert broker.topics()[0].lost == 2


def test_check_has_no_side_effect(broker: uorb.Broker) -> None:
    """`check` stays true until a copy on the same subscription, and false after it."""
    publication = broker.advertise(OrbTest)
    one, other = broker.subscribe(OrbTest), broker.subscribe(OrbTest)
    assert not one.check()
    publish(publication, 1)
    assert all(one.check() for _ in range(3))
    assert other.copy().val == 1
    assert one.check()
    assert one.copy().val == 1
    assert not one.check()


def test_update_is_copy_if_check(broker: uorb.Broker) -> None:
    """`update` returns each update once and None otherwise."""
    publication = broker.advertise(OrbTest)
    subscription = broker.subscribe(OrbTest)
    assert subscription.update() is None
    publish(publication, 7)
    message = subscription.update()
    assert message is not None
    assert message.val == 7
    assert subscription.update() is None


def test_sample_numbers_count_from_one(broker: uorb.Broker) -> None:
    """`SampleInfo.generation` is the sample's number, `generation` the reader's position."""
    publication = broker.advertise(OrbTest, queue_length=3)
    subscription = broker.subscribe(OrbTest)
    before = uorb.hrt_absolute_time()
    publish(publication, 1, 2, 3)
    after = uorb.hrt_absolute_time()
    for number in (1, 2, 3):
        message, info = subscription.copy_with_info()
        assert (message.val, info.generation, info.sequence) == (number, number, number)
        assert before <= info.published_us == info.received_us <= after
        assert info.origin == broker.host
        assert not info.latched
        assert subscription.generation == number
    assert broker.topics()[0].generation == 3


def test_copy_with_info_counts_as_a_copy(broker: uorb.Broker) -> None:
    """It moves the position and counts losses as `copy` does."""
    publication = broker.advertise(OrbTest, queue_length=2)
    subscription = broker.subscribe(OrbTest)
    publish(publication, 1, 2, 3)
    assert subscription.copy_with_info().message.val == 2
    assert subscription.copy().val == 3
    assert subscription.lost == 1
    assert subscription.copy_with_info().message.val == 3
    assert not subscription.check()


def test_iteration_gives_every_sample_in_turn(broker: uorb.Broker) -> None:
    """`for message in subscription` yields each unread sample."""
    publication = broker.advertise(OrbTest, queue_length=8)
    subscription = broker.subscribe(OrbTest)
    publish(publication, *range(5))
    assert [message.val for _, message in zip(range(5), subscription)] == [0, 1, 2, 3, 4]


def test_timestamp_is_stamped_only_where_zero(broker: uorb.Broker) -> None:
    """A zero timestamp becomes the time of publication; another value is left alone."""
    publication = broker.advertise(OrbTest, queue_length=2)
    subscription = broker.subscribe(OrbTest)
    before = uorb.hrt_absolute_time()
    publication.publish(OrbTest(val=1))
    publication.publish(OrbTest(timestamp=5, val=2))
    assert before <= subscription.copy().timestamp <= uorb.hrt_absolute_time()
    assert subscription.copy().timestamp == 5


def test_a_value_that_does_not_fit_changes_nothing(broker: uorb.Broker) -> None:
    """`EncodeError` comes before anything is written: no generation, no update."""
    publication = broker.advertise(OrbTest)
    subscription = broker.subscribe(OrbTest)
    with pytest.raises(uorb.EncodeError):
        publication.publish(OrbTest(val=1 << 40))
    assert broker.topics()[0].generation == 0
    assert not subscription.check()


# -- starts ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("start", "updates"),
    [("latest", [[], [4], [4]]), ("new", [[], [], []]), ("oldest", [[], [4], [2, 3, 4]])],
)
def test_starts(broker: uorb.Broker, start: str, updates: list[list[int]]) -> None:
    """`latest`: exactly the newest; `new`: none; `oldest`: what the queue retains. Without data: none."""
    for depth, written, expected in ((1, 0, updates[0]), (1, 4, updates[1]), (3, 4, updates[2])):
        publication = broker.advertise_multi(OrbTest, queue_length=depth)
        publish(publication, *range(1, written + 1))
        subscription = broker.subscribe(OrbTest, publication.instance, start=start)
        assert subscription.pending == len(expected)
        assert subscription.check() == bool(expected)
        assert drain(subscription) == expected
        assert subscription.lost == 0
        publish(publication, 9)
        assert drain(subscription) == [9]
        assert subscription.lost == 0


@pytest.mark.parametrize("start", ["latest", "new", "oldest"])
def test_a_first_copy_gives_what_is_there_whatever_the_start(broker: uorb.Broker, start: str) -> None:
    """An unconditional copy right after subscribing returns data, also where it is no update."""
    broker.advertise(OrbTest, OrbTest(val=3))
    subscription = broker.subscribe(OrbTest, start=start)
    assert subscription.copy().val == 3
    assert subscription.lost == 0


def test_unread_before_the_subscription_is_not_lost(broker: uorb.Broker) -> None:
    """Samples older than the subscription never count, for any start."""
    publication = broker.advertise(OrbTest, queue_length=4)
    publish(publication, *range(100))
    readers = [broker.subscribe(OrbTest, start=start) for start in ("latest", "new", "oldest")]
    publish(publication, 100)
    assert [drain(reader) for reader in readers] == [[99, 100], [100], [97, 98, 99, 100]]
    assert [reader.lost for reader in readers] == [0, 0, 1]


def test_an_unknown_start_is_refused(broker: uorb.Broker) -> None:
    """Anything but the three names is a ValueError that lists them."""
    with pytest.raises(ValueError, match="latest, new, oldest"):
        broker.subscribe(OrbTest, start="first")


def test_a_first_message_given_to_advertise_is_published(broker: uorb.Broker) -> None:
    """`advertise(topic, data)` publishes the data; data that does not fit leaves no advertisement."""
    publication = broker.advertise("orb_test", OrbTest(val=5))
    assert broker.subscribe("orb_test").copy().val == 5
    publication.unadvertise()
    with pytest.raises(uorb.EncodeError):
        broker.advertise("orb_test", OrbTest(val=1 << 40))
    assert not broker.exists("orb_test")
    with pytest.raises(uorb.TopicMismatchError):
        broker.advertise("orb_test", OrbTestMedium())
    assert not broker.exists("orb_test")


@pytest.mark.parametrize("start", [(1 << 31) - 3, (1 << 32) - 3, (1 << 53) - 3, (1 << 61) - 3])
def test_generations_never_wrap(broker: uorb.Broker, start: int) -> None:
    """62 bits, at a million samples a second 146,000 years: no width on the way means anything."""
    publication = broker.advertise(OrbTest, queue_length=4)
    mapping = publication._node.mapping
    mapping.words[W_G] = mapping.words[W_FLOOR] = start
    subscription = broker.subscribe(OrbTest)
    for value in range(6):
        publication.publish(OrbTest(val=value))
    assert subscription.pending == 4
    assert [subscription.copy().val for _ in range(5)] == [2, 3, 4, 5, 5]
    assert subscription.lost == 2
    assert subscription.generation == start + 6
    assert subscription.copy_with_info().info.generation == start + 6
    assert broker.topics()[0].generation == start + 6
