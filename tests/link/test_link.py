"""What a user of two hosts sees: mirrored topics, demand, latched samples, no echo, definitions, peers."""

from collections.abc import Callable
from pathlib import Path
from threading import enumerate as threads
from typing import Any

import pytest

import uorb_net as uorb
from communicator import MemoryNetwork, ZenohChannel
from uorb_net import messages
from uorb_net.messages.registry import Registry
from uorb_net.msg import SensorCombined, VehicleAttitude, VehicleCommand

Until = Callable[..., bool]


def attitude(number: int) -> Any:
    return VehicleAttitude(timestamp=1000 + number, timestamp_sample=number)


def test_late_subscriber_gets_the_newest_sample_latched_and_once(vehicle: Any) -> None:
    """The sample from before the subscription comes alone, marked, with its origin."""
    autopilot, _ = vehicle.host("autopilot")
    companion, _ = vehicle.host("companion")
    publication = autopilot.advertise(VehicleAttitude, queue_length=8)
    for number in range(5):
        publication.publish(attitude(number))
    subscription = companion.subscribe(VehicleAttitude)
    assert subscription.wait(5.0)
    sample = subscription.copy_with_info()
    assert sample.message == attitude(4)
    assert sample.info.latched
    assert (sample.info.origin, sample.info.sequence, sample.info.generation) == ("autopilot", 5, 1)
    assert not subscription.wait(0.1)
    publication.publish(attitude(5))
    assert subscription.wait(5.0)
    sample = subscription.copy_with_info()
    assert not sample.info.latched
    assert sample.message == attitude(5)
    assert 0 < sample.info.published_us <= sample.info.received_us


def test_a_new_subscription_can_copy_the_latched_sample_but_gets_no_update(vehicle: Any, eventually: Until) -> None:
    """start="new": what was published before is there, and is no news."""
    autopilot, _ = vehicle.host("autopilot")
    companion, _ = vehicle.host("companion")
    publication = autopilot.advertise(VehicleAttitude, attitude(1), queue_length=4)
    assert eventually(lambda: companion.exists("vehicle_attitude"))
    subscription = companion.subscribe(VehicleAttitude, start="new")
    assert eventually(lambda: companion.topics()[0].generation == 1)
    assert not subscription.wait(0.05)
    assert subscription.copy() == attitude(1)
    publication.publish(attitude(2))
    assert subscription.wait(5.0)
    assert subscription.copy() == attitude(2)
    assert subscription.lost == 0


def test_a_burst_on_a_queue_arrives_complete_and_in_order(vehicle: Any) -> None:
    """A queued topic loses nothing while the queue reaches."""
    autopilot, _ = vehicle.host("autopilot")
    companion, link = vehicle.host("companion")
    publication = autopilot.advertise(VehicleAttitude, attitude(0), queue_length=255)
    subscription = companion.subscribe(VehicleAttitude)
    assert subscription.wait(5.0)
    assert subscription.queue_length == 255
    for number in range(1, 201):
        publication.publish(attitude(number))
    got: list[int] = []
    while len(got) < 201 and subscription.wait(5.0):
        got.append(subscription.copy().timestamp_sample)
    assert got == list(range(201))
    assert subscription.lost == 0
    assert link.stats().lost == 0


def test_nothing_crosses_without_a_subscriber(vehicle: Any, eventually: Until) -> None:
    """Advertisements are mirrored, samples only on demand, and the flow stops with the last subscriber."""
    autopilot, sender = vehicle.host("autopilot")
    companion, _ = vehicle.host("companion")
    publication = autopilot.advertise(VehicleAttitude, attitude(0))
    assert eventually(lambda: companion.exists("vehicle_attitude"))
    for number in range(50):
        publication.publish(attitude(number))
    assert not eventually(lambda: sender.stats().sent_samples, 0.3)
    with companion.subscribe(VehicleAttitude) as subscription:
        assert subscription.wait(5.0)
    sent = sender.stats().sent_samples
    assert sent == 1

    def stopped() -> bool:
        before = sender.stats().sent_samples
        publication.publish(attitude(99))
        return not eventually(lambda: sender.stats().sent_samples > before, 0.1)

    assert eventually(stopped)


def test_several_subscribers_on_a_host_share_one_transfer(vehicle: Any, eventually: Until) -> None:
    """Wire traffic depends on hosts, not on subscribers."""
    autopilot, sender = vehicle.host("autopilot")
    companion, _ = vehicle.host("companion")
    publication = autopilot.advertise(VehicleAttitude, attitude(0), queue_length=64)
    subscriptions = [companion.subscribe(VehicleAttitude) for _ in range(16)]
    assert all(subscription.wait(5.0) for subscription in subscriptions)
    before = sender.stats().sent_samples
    for number in range(20):
        publication.publish(attitude(number + 1))
    assert eventually(lambda: all(s.generation + s.pending == 21 for s in subscriptions))
    assert sender.stats().sent_samples - before == 20


def test_shared_instance_merges_hosts_without_echo(vehicle: Any, eventually: Until) -> None:
    """Two hosts publish instance 0: each sees each sample once, and whose it is."""
    autopilot, _ = vehicle.host("autopilot")
    companion, _ = vehicle.host("companion")
    here = autopilot.advertise(VehicleAttitude, queue_length=64)
    there = companion.advertise(VehicleAttitude, queue_length=64)
    readers = [b.subscribe(VehicleAttitude) for b in (autopilot, companion)]
    for broker in (autopilot, companion):
        assert eventually(lambda b=broker: b.topics()[0].publishers == 2)
    here.publish(attitude(1))
    assert all(reader.wait(5.0) for reader in readers)
    there.publish(attitude(2))
    assert eventually(lambda: all(reader.pending == 2 for reader in readers))
    for reader in readers:
        got = [reader.copy_with_info() for _ in range(2)]
        assert [(s.message.timestamp_sample, s.info.origin) for s in got] == [
            (1, "autopilot"),
            (2, "companion"),
        ]
        assert not reader.wait(0.1)
    assert [b.topics()[0].generation for b in (autopilot, companion)] == [2, 2]


def test_own_instances_keep_their_number_or_take_the_lowest_free(vehicle: Any, eventually: Until) -> None:
    """Instances of two hosts never merge."""
    autopilot, companion = uorb.Broker.private(), uorb.Broker.private()
    companion.advertise_multi(VehicleAttitude, attitude(7))
    for number in range(2):
        autopilot.advertise_multi(VehicleAttitude, attitude(number), priority=100)
    vehicle.host("autopilot", autopilot)
    vehicle.host("companion", companion)
    assert eventually(lambda: companion.group_count("vehicle_attitude") == 3)
    assert {s.instance: s.origin for s in companion.topics()}[0] == "companion"
    found = set()
    for instance in (1, 2):
        reader = companion.subscribe(VehicleAttitude, instance)
        assert reader.wait(5.0)
        found.add(reader.copy().timestamp_sample)
        assert reader.priority == 100
    assert found == {0, 1}


def test_interval_is_applied_at_the_sender_and_the_last_sample_arrives(vehicle: Any, eventually: Until) -> None:
    """A slow subscriber costs few transfers; what was held back is no loss; the burst's end comes."""
    autopilot, sender = vehicle.host("autopilot")
    companion, link = vehicle.host("companion")
    publication = autopilot.advertise(VehicleAttitude, attitude(0))
    subscription = companion.subscribe(VehicleAttitude, interval=0.2)
    assert subscription.wait(5.0)
    subscription.copy()
    before = sender.stats().sent_samples
    for number in range(1, 101):
        publication.publish(attitude(number))

    def ended() -> bool:
        message = subscription.update()
        return message is not None and message.timestamp_sample == 100

    assert eventually(ended)
    assert sender.stats().sent_samples - before <= 4
    assert link.stats().lost == 0


def test_unadvertise_and_readvertise_cross(vehicle: Any, eventually: Until) -> None:
    """The last publisher's going is seen, and so is its return; the old sample does not come back."""
    autopilot, _ = vehicle.host("autopilot")
    companion, _ = vehicle.host("companion")
    subscription = companion.subscribe(VehicleAttitude)
    publication = autopilot.advertise(VehicleAttitude, attitude(1))
    assert subscription.wait(5.0)
    subscription.copy()
    publication.unadvertise()
    assert eventually(lambda: not companion.exists("vehicle_attitude"))
    with pytest.raises(uorb.NoDataError):
        subscription.copy()
    publication = autopilot.advertise(VehicleAttitude)
    assert eventually(lambda: companion.exists("vehicle_attitude"))
    assert not subscription.wait(0.1)
    publication.publish(attitude(2))
    assert subscription.wait(5.0)
    assert subscription.copy() == attitude(2)


def test_a_peer_that_stops_takes_its_topics_along_and_brings_them_back(vehicle: Any, eventually: Until) -> None:
    """Stop and start again under the same name: the other host follows by itself."""
    autopilot, link = vehicle.host("autopilot")
    companion, other = vehicle.host("companion")
    publication = autopilot.advertise(VehicleAttitude, attitude(1))
    subscription = companion.subscribe(VehicleAttitude)
    assert subscription.wait(5.0)
    subscription.copy()
    link.stop()
    assert eventually(lambda: other.peers()[0].state == "down")
    assert eventually(lambda: not companion.exists("vehicle_attitude"))
    publication.publish(attitude(2))
    link.start()
    assert other.wait_for_peer("autopilot", 5.0)
    assert subscription.wait(5.0)
    assert subscription.copy() == attitude(2)
    kinds = [event.text.split(",")[0] for event in other.events() if event.kind == "peer"]
    assert kinds == ["autopilot is up", "autopilot is down", "autopilot is up"]


def test_a_topic_not_defined_here_is_mirrored_with_its_publishers_text(
    vehicle: Any, eventually: Until, tmp_path: Path
) -> None:
    """The definition crosses: subscribing by name needs nothing installed."""
    (tmp_path / "OnlyThere.msg").write_text("uint64 timestamp\nfloat32 height # metres\n")
    foreign = Registry(str(tmp_path)).load("OnlyThere")
    autopilot, _ = vehicle.host("autopilot")
    companion, _ = vehicle.host("companion")
    autopilot.advertise(foreign, foreign(timestamp=1, height=2.5))
    assert eventually(lambda: any(s.topic == "only_there" for s in companion.topics()))
    subscription = companion.subscribe("only_there")
    assert subscription.wait(5.0)
    assert subscription.copy().height == 2.5


def test_a_definition_that_differs_is_refused_and_named_on_both_sides(
    vehicle: Any, eventually: Until, tmp_path: Path
) -> None:
    """One event on each side names field and types; other topics flow."""
    text = messages.definition("VehicleAttitude").replace("float32[4] q ", "float64[4] q ")
    (tmp_path / "VehicleAttitude.msg").write_text(text)
    other = Registry(str(tmp_path)).load("VehicleAttitude")
    autopilot, sender = vehicle.host("autopilot")
    companion, link = vehicle.host("companion")
    blocked = companion.subscribe(VehicleAttitude)
    flowing = companion.subscribe(SensorCombined)
    autopilot.advertise(other, other(timestamp=1))
    autopilot.advertise(SensorCombined, SensorCombined(timestamp=2))
    assert flowing.wait(5.0)
    for side in (link, sender):
        assert eventually(lambda s=side: any(e.kind == "definition" for e in s.events()))
        events = [event for event in side.events() if event.kind == "definition"]
        assert len(events) == 1
        assert events[0].topic == "vehicle_attitude"
        assert "q" in events[0].text
        assert "float32[4]" in events[0].text
        assert "float64[4]" in events[0].text
        assert side.stats().mismatched == 1
    assert not blocked.check()


def test_a_local_definition_wins_over_a_mirror(vehicle: Any, eventually: Until, tmp_path: Path) -> None:
    """A subscriber with its own definition takes the topic from a mirror that nobody here uses."""
    (tmp_path / "VehicleAttitude.msg").write_text("uint64 timestamp\nfloat64 q\n")
    other = Registry(str(tmp_path)).load("VehicleAttitude")
    autopilot, _ = vehicle.host("autopilot")
    companion, link = vehicle.host("companion")
    autopilot.advertise(other, other(timestamp=1))
    assert eventually(lambda: companion.exists("vehicle_attitude"))
    subscription = companion.subscribe(VehicleAttitude)
    assert eventually(lambda: any(e.kind == "definition" for e in link.events()))
    assert not subscription.check()
    publication = companion.advertise(VehicleAttitude, attitude(3))
    assert subscription.copy() == attitude(3)
    publication.unadvertise()


def test_three_hosts_see_each_other_once(vehicle: Any, eventually: Until) -> None:
    """A full mesh: one publisher, two remote readers, no sample twice."""
    brokers = [vehicle.host(name)[0] for name in ("autopilot", "companion", "ground")]
    publication = brokers[0].advertise(VehicleCommand, VehicleCommand(timestamp=1, command=1))
    readers = [broker.subscribe(VehicleCommand) for broker in brokers[1:]]
    assert all(reader.wait(5.0) for reader in readers)
    for number in range(2, 9):
        publication.publish(VehicleCommand(timestamp=number, command=number))
    assert eventually(lambda: all(reader.pending == 8 for reader in readers))
    for reader in readers:
        assert [reader.copy().command for _ in range(8)] == list(range(1, 9))
    for broker in brokers:
        assert broker.group_count("vehicle_command") == 1
        assert broker.topics()[0].generation == 8


def test_the_clock_offset_is_measured(vehicle: Any, eventually: Until) -> None:
    """Both hosts share this machine's clock, so the offset is about nothing."""
    vehicle.host("autopilot")
    _, link = vehicle.host("companion")
    assert eventually(lambda: link.peers()[0].clock_offset is not None)
    status = link.peers()[0]
    assert status.round_trip is not None
    assert status.clock_offset is not None
    assert status.clock_uncertainty is not None
    assert abs(status.clock_offset) <= status.clock_uncertainty + 1e-4


@pytest.mark.parametrize("seconds", [0.1, 0.6])
@pytest.mark.parametrize("queue_length", [1, 16])
def test_the_books_balance_across_a_cut(seconds: float, queue_length: int, eventually: Until) -> None:
    """Shorter or longer than the lease: published = received + lost, with the newest sample there afterwards."""
    network = MemoryNetwork(lease=0.3)
    with uorb.Broker.private() as here, uorb.Broker.private() as there:
        sender = uorb.Link(here, network.channel(), host="here").start()
        receiver = uorb.Link(there, network.channel(), host="there").start()
        publication = here.advertise(VehicleAttitude, attitude(0), queue_length=queue_length)
        subscription = there.subscribe(VehicleAttitude)
        assert subscription.wait(5.0)
        network.cut("here", "there")
        for number in range(1, 101):
            publication.publish(attitude(number))
        if seconds > 0.3:
            assert eventually(lambda: receiver.peers()[0].state == "down")
            assert eventually(lambda: sender.peers()[0].state == "down")
        network.heal("here", "there")
        assert receiver.wait_for_peer("here", 5.0)

        def balanced() -> bool:
            stats = receiver.stats()
            return stats.received_samples + stats.lost == 101

        assert eventually(balanced), receiver.stats()
        assert receiver.stats().lost > 0
        if seconds < 0.3:  # the node still is the one the losses were counted for
            assert there.survey()[0].link_lost == receiver.stats().lost
        assert subscription.copy().timestamp_sample == 100 or queue_length > 1


@pytest.mark.parametrize("queue_length", [1, 255])
def test_the_books_balance_on_a_lossy_network(queue_length: int, eventually: Until) -> None:
    """A fifth of all frames lost, some doubled and overtaken: a queue is complete, all is accounted for."""
    network = MemoryNetwork(seed=3)
    with uorb.Broker.private() as here, uorb.Broker.private() as there:
        uorb.Link(here, network.channel(), host="here").start()
        receiver = uorb.Link(there, network.channel(), host="there").start()
        assert receiver.wait_for_peer("here", 5.0)
        publication = here.advertise(VehicleAttitude, attitude(0), queue_length=queue_length)
        subscription = there.subscribe(VehicleAttitude)
        assert subscription.wait(5.0)
        for pair in (("here", "there"), ("there", "here")):
            network.set_link(*pair, loss=0.2, duplicate=0.1, reorder=0.1)
        got = [subscription.copy().timestamp_sample]
        for number in range(1, 301):
            publication.publish(attitude(number))
            if number % 10 == 0:
                while subscription.wait(0.003):
                    got.append(subscription.copy().timestamp_sample)

        def balanced() -> bool:
            while subscription.check():
                got.append(subscription.copy().timestamp_sample)
            stats = receiver.stats()
            return stats.received_samples + stats.lost == 301

        assert eventually(balanced, 15.0), receiver.stats()
        assert got == sorted(set(got)), "a sample came twice or out of order"
        assert len(got) + receiver.stats().lost + subscription.lost == 301
        if queue_length > 1:
            assert receiver.stats().retransmitted > 0


def test_one_link_per_bus_and_kind_of_channel() -> None:
    """A second one is refused with the holder's process id; after stop the place is free."""
    network = MemoryNetwork()
    with uorb.Broker.private() as broker:
        first = uorb.Link(broker, network.channel(), host="a").start()
        with pytest.raises(uorb.LinkError, match=r"in process [0-9]+"):
            uorb.Link(broker, network.channel(), host="b").start()
        first.stop()
        uorb.Link(broker, network.channel(), host="b").start().stop()


def test_stop_leaves_no_thread() -> None:
    """After stop nothing of the link runs, whether or not anyone was there."""
    before = set(threads())
    with uorb.Broker.private() as broker, uorb.Link(broker, ZenohChannel(), host="alone") as link:
        assert not link.wait_for_peer("nobody", 0.05)
    assert {thread for thread in set(threads()) - before if thread.name.startswith("uorb")} == set()


def test_a_port_in_use_is_a_link_error_naming_it() -> None:
    """The endpoint that cannot be listened on is named, and the bus is free for another try."""
    import socket

    with socket.socket() as taken, uorb.Broker.private() as broker:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        link = uorb.Link(broker, ZenohChannel(listen=[f"tcp/127.0.0.1:{port}"]), host="late")
        with pytest.raises(uorb.LinkError, match=str(port)):
            link.start()
        uorb.Link(broker, ZenohChannel(), host="late").start().stop()
