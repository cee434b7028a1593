"""What the bus tells of itself, and the errors of wrong calls."""

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import uorb_net as uorb
from uorb_net import messages
from uorb_net.messages import Message
from uorb_net.msg import OrbTest, OrbTestLarge, OrbTestMedium, SensorAccel


def test_stat(broker: uorb.Broker) -> None:
    """Microseconds of the last write, not the message's timestamp; 0 for never; kept after unadvertise."""
    publication = broker.advertise(OrbTest)
    subscription = broker.subscribe(OrbTest)
    assert subscription.stat() == 0
    before = uorb.hrt_absolute_time()
    publication.publish(OrbTest(timestamp=1))
    stamp = subscription.stat()
    assert before <= stamp <= uorb.hrt_absolute_time()
    assert subscription.check()  # it consumes nothing
    publication.publish(OrbTest(timestamp=1))
    assert subscription.stat() >= stamp
    publication.unadvertise()
    assert subscription.stat() >= stamp


def test_topics_lists_every_node(broker: uorb.Broker) -> None:
    """A frozen status per node, sorted by topic and instance, also of nodes nobody advertises."""
    assert broker.topics() == []
    publication = broker.advertise_multi("orb_multitest", OrbTest(), priority=100, queue_length=3)
    others = [broker.advertise_multi("orb_multitest") for _ in range(10 - 1)]
    readers: list[Any] = [broker.subscribe("orb_multitest", 9), *(broker.subscribe(SensorAccel) for _ in range(2))]
    statuses = broker.topics()
    keys = [(status.topic, status.instance) for status in statuses]
    assert keys == [*(("orb_multitest", n) for n in range(10)), ("sensor_accel", 0)]
    first, last = statuses[0], statuses[-1]
    assert first == uorb.TopicStatus(
        topic="orb_multitest",
        instance=0,
        type="OrbTest",
        type_hash=OrbTest.__uorb__.type_hash,
        advertised=True,
        publishers=1,
        subscribers=0,
        queue_length=3,
        generation=1,
        lost=0,
        priority=100,
        origin=broker.host,
    )
    assert (last.advertised, last.publishers, last.subscribers, last.generation) == (False, 0, 2, 0)
    assert statuses[9].subscribers == 1
    with pytest.raises(AttributeError):
        first.lost = 1  # type: ignore[misc]
    users: list[Any] = [publication, *others, *readers]
    for user in users:
        user.close()
    assert not any(s.advertised or s.publishers or s.subscribers for s in broker.topics())


def test_a_topic_may_be_named_three_ways(broker: uorb.Broker) -> None:
    """A name, a message type (its first topic), or an object with a `topic`, as ORB_ID gives."""

    class Handle:
        topic = "orb_test"

    broker.advertise(OrbTest, OrbTest(val=3))
    for topic in (OrbTest, "orb_test", Handle()):
        assert broker.subscribe(topic).copy() == broker.subscribe(topic).copy()
        assert broker.exists(topic)
    assert OrbTest.__uorb__.topics[0] == "orb_test"
    wrong: Any = 5
    with pytest.raises(TypeError, match="topic = 5"):
        broker.subscribe(wrong)


@pytest.mark.parametrize("call", ["advertise", "advertise_multi", "subscribe", "exists", "group_count"])
def test_an_unknown_topic_is_refused_with_a_suggestion(broker: uorb.Broker, call: str) -> None:
    """UnknownTopicError (ENOENT) that names a similar topic; nothing is made."""
    with pytest.raises(uorb.UnknownTopicError, match="sensor_accel") as caught:
        getattr(broker, call)("sensor_acel")
    assert caught.value.errno == 2
    assert broker.topics() == []


@pytest.mark.parametrize("name", ["", ".", "..", "../x", "a/b", "a-b", "orb_test.1", ".lock", "x" * 300, "ä\0"])
def test_names_that_are_no_topics(broker: uorb.Broker, name: str) -> None:
    """No name reaches outside the folder or into its other files."""
    for call in (broker.advertise, broker.subscribe, broker.exists, broker.group_count):
        with pytest.raises(uorb.UnknownTopicError):
            call(name)
    with pytest.raises(uorb.BusError) as caught:
        broker.advertise_instance(OrbTest, name, 0)
    assert caught.value.errno == 22
    assert broker.topics() == []


def test_a_message_of_another_type_is_refused(broker: uorb.Broker) -> None:
    """TopicMismatchError (EINVAL) before anything is written."""
    publication = broker.advertise(OrbTest)
    wrong: Any = OrbTestMedium()
    with pytest.raises(uorb.TopicMismatchError) as caught:
        publication.publish(wrong)
    assert caught.value.errno == 22
    nothing: Any = None
    with pytest.raises(uorb.TopicMismatchError):
        publication.publish(nothing)
    with pytest.raises(ValueError, match="bytes"):
        publication.publish_encoded(b"123")
    assert broker.topics()[0].generation == 0


def test_encoded_samples(broker: uorb.Broker) -> None:
    """`publish_encoded` writes what `encode` made."""
    publication = broker.advertise(OrbTestLarge)
    message = OrbTestLarge(timestamp=1, val=2, junk=os.urandom(512))
    publication.publish_encoded(messages.encode(message))
    assert broker.subscribe(OrbTestLarge).copy() == message


@pytest.fixture
def foreign(tmp_path: Path) -> tuple[type[Message], type[Message]]:
    """Two definitions of one name that is not installed, which differ in one field."""
    texts = [f"uint64 timestamp\n{kind}[4] q\n# TOPICS strange_topic" for kind in ("float32", "float64")]
    one, other = (messages.from_text("StrangeTopic", text) for text in texts)
    return one, other


@pytest.mark.parametrize("user", ["publication", "subscription"])
def test_another_definition_is_refused_naming_the_field(
    broker: uorb.Broker, foreign: tuple[type[Message], type[Message]], user: str
) -> None:
    """While someone uses a node with one definition, another is TopicMismatchError; then it may be replaced."""
    mine, theirs = foreign
    used: Any = broker.advertise(mine) if user == "publication" else broker.subscribe(mine)
    for call in (broker.advertise, broker.subscribe):
        with pytest.raises(uorb.TopicMismatchError, match=r"q: float64\[4\] here, float32\[4\] there") as caught:
            call(theirs)
        assert caught.value.errno == 22
        assert str(os.getpid()) in str(caught.value)
    used.close()
    publication = broker.advertise(theirs)
    publication.publish(theirs(q=(1, 2, 3, 4)))
    assert broker.subscribe(theirs).copy().q == (1, 2, 3, 4)  # type: ignore[attr-defined]
    assert [status.type_hash for status in broker.topics()] == [theirs.__uorb__.type_hash]


def test_a_definition_that_only_the_node_knows(
    broker: uorb.Broker, foreign: tuple[type[Message], type[Message]]
) -> None:
    """A name nobody installed works once a publisher brought its definition."""
    mine, _ = foreign
    with pytest.raises(uorb.UnknownTopicError):
        broker.subscribe("strange_topic")
    with pytest.raises(uorb.UnknownTopicError):
        broker.exists("strange_topic")
    broker.advertise(mine, mine(q=(1, 2, 3, 4)))
    assert broker.exists("strange_topic")
    assert broker.group_count("strange_topic") == 1
    assert broker.subscribe("strange_topic").copy().q == (1, 2, 3, 4)
    assert broker.advertise("strange_topic").queue_length == 1


def test_a_definition_from_another_process(
    shared: uorb.Broker, script: Callable[..., Any], foreign: tuple[type[Message], type[Message]]
) -> None:
    """The text travels in the node: no definition is needed where the topic is read."""
    mine, theirs = foreign
    shared.advertise(mine, mine(q=(4, 3, 2, 1)))
    reader = script(
        """
broker = uorb.Broker()
print(broker.subscribe("strange_topic").copy().q, broker.group_count("strange_topic"), flush=True)
try: broker.advertise(uorb.messages.from_text("StrangeTopic", sys.argv[1]))
except uorb.TopicMismatchError as error: say(error)
""",
        theirs.__uorb__.definition,
    )
    assert reader.hear() == "(4.0, 3.0, 2.0, 1.0) 1"
    text = reader.hear()
    assert "float64[4] here, float32[4] there" in text
    assert str(os.getpid()) in text


def test_everything_on_a_closed_subscription_raises(broker: uorb.Broker) -> None:
    """ClosedError (EBADF) from every call; a second close does nothing."""
    broker.advertise(OrbTest, OrbTest())
    subscription = broker.subscribe(OrbTest)
    subscription.close()
    subscription.close()

    def set_interval() -> None:
        subscription.interval = 1.0

    calls: list[Callable[[], object]] = [
        subscription.check,
        subscription.copy,
        subscription.copy_with_info,
        subscription.update,
        subscription.wait,
        subscription.stat,
        subscription.fileno,
        lambda: subscription.wait(0.0),
        lambda: next(iter(subscription)),
        lambda: uorb.poll([subscription], 0),
        lambda: subscription.advertised,
        lambda: subscription.pending,
        lambda: subscription.generation,
        lambda: subscription.queue_length,
        lambda: subscription.priority,
        set_interval,
    ]
    for call in calls:
        with pytest.raises(uorb.ClosedError) as caught:
            call()
        assert caught.value.errno == 9


def test_everything_on_a_closed_broker_raises(broker: uorb.Broker) -> None:
    """Closing closes what was opened through it; then every call raises ClosedError; a second close does nothing."""
    publication, subscription = broker.advertise(OrbTest), broker.subscribe(OrbTest)
    broker.close()
    broker.close()
    calls: list[Callable[[], object]] = [
        lambda: publication.publish(OrbTest()),
        subscription.check,
        lambda: broker.advertise(OrbTest),
        lambda: broker.advertise_multi(OrbTest),
        lambda: broker.subscribe(OrbTest),
        lambda: broker.exists(OrbTest),
        lambda: broker.group_count(OrbTest),
        broker.topics,
    ]
    for call in calls:
        with pytest.raises(uorb.ClosedError):
            call()


def test_brokers_of_one_process_share_the_bus(shared: uorb.Broker) -> None:
    """Closing one of two leaves the other's publications; vehicles are apart."""
    with uorb.Broker() as second, uorb.Broker("other") as elsewhere:
        publication = second.advertise(OrbTest, OrbTest(val=1))
        subscription = shared.subscribe(OrbTest)
        assert subscription.copy().val == 1
        assert elsewhere.topics() == []
        assert not elsewhere.exists(OrbTest)
        kept = shared.advertise(OrbTest)
        assert shared.topics()[0].publishers == 2
    assert shared.topics()[0].publishers == 1
    kept.publish(OrbTest(val=2))
    assert subscription.copy().val == 2
    with pytest.raises(uorb.ClosedError):
        publication.publish(OrbTest())


def test_the_vehicle_comes_from_the_environment(runtime_dir: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """$UORB_VEHICLE unless given, else "default"; odd names are refused."""
    with uorb.Broker() as broker:
        assert broker.path == str(runtime_dir / "default")
    monkeypatch.setenv("UORB_VEHICLE", "uav1")
    with uorb.Broker() as broker, uorb.Broker("uav2") as other:
        assert broker.path == str(runtime_dir / "uav1")
        assert other.path == str(runtime_dir / "uav2")
    for name in ("..", ".hidden", "a/b", "x" * 65, "a b"):
        with pytest.raises(ValueError, match="vehicle"):
            uorb.Broker(name)


def test_private_buses_are_apart() -> None:
    """Two private brokers share nothing."""
    with uorb.Broker.private() as one, uorb.Broker.private() as other:
        one.advertise(OrbTest, OrbTest())
        assert one.exists(OrbTest)
        assert not other.exists(OrbTest)


def test_error_numbers() -> None:
    """The errno of each class is uORB's, and all are UorbErrors."""
    expected = {
        uorb.UnknownTopicError: 2,
        uorb.NoDataError: 5,
        uorb.InstanceError: 5,
        uorb.TopicMismatchError: 22,
        uorb.ClosedError: 9,
        uorb.QueueLengthError: 22,
        uorb.BusyError: 11,
        uorb.LinkError: 5,
        uorb.SpinnerError: 16,
        uorb.ServiceError: 5,
    }
    for error, number in expected.items():
        assert issubclass(error, uorb.UorbError)
        assert error.errno == number
