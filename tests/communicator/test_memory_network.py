"""The network in this process does exactly what its script says, and what Zenoh's tokens would do."""

import threading
from dataclasses import replace

import pytest

from communicator import Advert, ChannelError, MemoryChannel, MemoryNetwork, Peer, SampleHeader
from communicator.recorder import Event, Recorder

ADVERT = Advert("imu", 0, "T", "h", 8, 1, 50, True)
End = tuple[MemoryChannel, Recorder]


def join(network: MemoryNetwork, host: str, vehicle: str = "uav1") -> End:
    """Start a channel and return it with its handler."""
    channel, handler = network.channel(), Recorder()
    channel.register_handler(handler)
    channel.start(vehicle, host)
    return channel, handler


def pair(network: MemoryNetwork) -> tuple[End, End]:
    """Two hosts, a's topic known to b, b's wish known to a; on a manual network."""
    a, b = join(network, "a"), join(network, "b")
    a[0].topic_advertised(ADVERT)
    network.advance(0)
    b[0].add_subscription(a[0].own, "imu", 0, 0)
    network.advance(0)
    return a, b


def send(channel: MemoryChannel, peer: Peer, first: int, count: int) -> None:
    """Send samples first..first+count-1 in one flush."""
    for number in range(first, first + count):
        channel.send_message(peer, "imu", 0, SampleHeader(number, 0), b"%d" % number)
    channel.flush()


def numbers(handler: Recorder) -> list[int]:
    """The sequence numbers received so far."""
    found = []
    for _, _, _, header, payload in handler.named("received_message"):
        assert isinstance(header, SampleHeader)
        assert payload == b"%d" % header.sequence
        found.append(header.sequence)
    return found


def test_nothing_moves_until_time_does() -> None:
    network = MemoryNetwork(manual=True)
    a, b = join(network, "a"), join(network, "b")
    assert a[1].events == b[1].events == []
    network.advance(0)
    assert a[1].events == [("peer", b[0].own, True)]
    assert b[1].events == [("peer", a[0].own, True)]


def test_all_verbs_cross() -> None:
    network = MemoryNetwork(manual=True)
    (a, ra), (b, rb) = pair(network)
    a.send_message(b.own, "imu", 0, SampleHeader(7, 1, withheld=2, latched=True), b"payload")
    a.send_control(b.own, b"hello")
    network.advance(0)
    assert len(rb.events) == 2  # not flushed yet
    a.flush()
    network.advance(0)
    b.remove_subscription(a.own, "imu", 0)
    a.topic_unadvertised("imu", 0)
    network.advance(0)
    received = rb.named("received_message")[0]
    header = received[3]
    assert isinstance(header, SampleHeader)
    assert received == (a.own, "imu", 0, replace(header), b"payload")
    assert (header.sequence, header.withheld, header.latched) == (7, 2, True)
    assert rb.named("control") == [(a.own, b"hello")]
    assert rb.events[-1] == ("remote_topic", a.own, ADVERT, False)
    assert ra.events[1:] == [
        ("add_subscription", b.own, "imu", 0, 0),
        ("remove_subscription", b.own, "imu", 0),
    ]
    assert a.counters()["sent_bytes"] == b.counters()["received_bytes"] > 0


def test_age_is_the_time_a_sample_waited_at_its_sender() -> None:
    network = MemoryNetwork(manual=True)
    (a, _), (b, rb) = pair(network)
    network.advance(1.0)
    a.send_message(b.own, "imu", 0, SampleHeader(1, published_us=250_000), b"")
    a.flush()
    network.advance(5.0)
    assert rb.named("received_message")[0][3] == SampleHeader(1, 250_000, age_us=750_000)


def test_delay_is_per_direction() -> None:
    network = MemoryNetwork(manual=True)
    (a, ra), (b, rb) = pair(network)
    network.set_link("a", "b", delay=0.5)
    a.send_control(b.own, b"slow")
    b.send_control(a.own, b"fast")
    a.flush()
    b.flush()
    network.advance(0.499)
    assert (ra.named("control"), rb.named("control")) == ([(b.own, b"fast")], [])
    network.advance(0.001)
    assert rb.named("control") == [(a.own, b"slow")]
    assert network.now == pytest.approx(0.5)


def test_jitter_delays_and_keeps_order() -> None:
    network = MemoryNetwork(manual=True)
    (a, _), (b, rb) = pair(network)
    network.set_link("a", "b", jitter=0.1)
    send(a, b.own, 1, 50)
    network.advance(0.01)
    assert len(numbers(rb)) < 50
    network.advance(0.1)
    assert numbers(rb) == list(range(1, 51))


def script(seed: int) -> list[int]:
    """What gets through a bad link."""
    network = MemoryNetwork(manual=True, seed=seed)
    (a, _), (b, rb) = pair(network)
    network.set_link("a", "b", delay=0.02, jitter=0.01, loss=0.2, duplicate=0.2, reorder=0.2)
    for number in range(1, 101):
        send(a, b.own, number, 1)
        network.advance(0.001)
    network.advance(1.0)
    return numbers(rb)


def test_a_seed_decides_everything() -> None:
    assert script(1) == script(1)
    assert script(1) != script(2)


def test_loss_takes_samples_and_control_but_no_token() -> None:
    network = MemoryNetwork(manual=True)
    network.set_link("a", "b", loss=1.0)
    (a, _), (b, rb) = pair(network)
    send(a, b.own, 1, 10)
    a.send_control(b.own, b"x")
    a.flush()
    network.advance(1)
    assert [event[0] for event in rb.events] == ["peer", "remote_topic"]
    assert network.lost == 11
    network.set_link("a", "b", loss=0.3)
    send(a, b.own, 11, 1000)
    network.advance(1)
    assert 600 < len(numbers(rb)) < 800


def test_duplicates_come_twice() -> None:
    network = MemoryNetwork(manual=True)
    (a, _), (b, rb) = pair(network)
    network.set_link("a", "b", duplicate=1.0)
    send(a, b.own, 1, 3)
    network.advance(1)
    assert numbers(rb) == [1, 1, 2, 2, 3, 3]


def test_a_reordered_sample_is_overtaken_and_arrives() -> None:
    network = MemoryNetwork(manual=True)
    (a, _), (b, rb) = pair(network)
    network.set_link("a", "b", reorder=1.0)
    send(a, b.own, 1, 1)
    network.set_link("a", "b")
    send(a, b.own, 2, 2)
    network.advance(0)
    assert numbers(rb) == [2, 3]
    network.advance(0.01)
    assert numbers(rb) == [2, 3, 1]


def test_a_cut_shorter_than_the_lease_parts_nobody_and_loses_only_samples() -> None:
    network = MemoryNetwork(manual=True)
    (a, ra), (b, rb) = pair(network)
    ra.clear()
    rb.clear()
    network.cut("a", "b")
    send(a, b.own, 1, 1)
    a.topic_advertised(replace(ADVERT, topic="gps"))
    b.add_subscription(a.own, "imu", 0, 1000)
    network.advance(1.9)
    assert ra.events == rb.events == []
    network.heal("a", "b")
    network.advance(0)
    send(a, b.own, 2, 1)
    network.advance(5)
    assert rb.named("peer") == ra.named("peer") == []
    assert rb.named("remote_topic") == [(a.own, replace(ADVERT, topic="gps"), True)]
    assert ra.events == [("add_subscription", b.own, "imu", 0, 1000)]
    assert numbers(rb) == [2]


def test_a_cut_longer_than_the_lease_parts_both_and_healing_brings_all_back() -> None:
    network = MemoryNetwork(manual=True)
    (a, ra), (b, rb) = pair(network)
    ra.clear()
    rb.clear()
    network.cut("a", "b")
    network.advance(2.0)
    assert ra.events == [("peer", b.own, False)]
    assert rb.events == [("peer", a.own, False)]
    network.advance(30)
    network.heal("a", "b")
    network.advance(0)
    assert rb.events[1:] == [("peer", a.own, True), ("remote_topic", a.own, ADVERT, True)]
    # What b asked of the peer that went is gone with it: the link asks again.
    assert ra.events[1:] == [("peer", b.own, True)]
    b.add_subscription(a.own, "imu", 0, 0)
    network.advance(0)
    assert ra.events[2:] == [("add_subscription", b.own, "imu", 0, 0)]


def test_what_is_under_way_when_the_link_is_cut_is_lost() -> None:
    network = MemoryNetwork(manual=True)
    (a, _), (b, rb) = pair(network)
    network.set_link("a", "b", delay=0.1)
    send(a, b.own, 1, 1)
    a.topic_advertised(replace(ADVERT, topic="gps"))
    network.cut("a", "b")
    network.advance(1)
    network.heal("a", "b")
    network.advance(1)
    assert numbers(rb) == []
    assert rb.events[-1] == ("remote_topic", a.own, replace(ADVERT, topic="gps"), True)


def test_a_third_host_does_not_notice_a_cut() -> None:
    network = MemoryNetwork(manual=True)
    (a, _), _ = pair(network)
    _, rc = join(network, "c")
    network.advance(0)
    rc.clear()
    network.cut("a", "b")
    network.advance(10)
    assert rc.events == []
    a.stop()
    network.advance(0)
    assert rc.named("peer") == [(a.own, False)]


@pytest.mark.parametrize("heal_after", [1.0, 5.0])
def test_a_host_that_leaves_behind_a_cut_is_gone_afterwards(heal_after: float) -> None:
    network = MemoryNetwork(manual=True)
    (a, _), (_, rb) = pair(network)
    network.cut("a", "b")
    a.stop()
    network.advance(heal_after)
    network.heal("a", "b")
    network.advance(0)
    assert rb.named("peer") == [(a.own, True), (a.own, False)]
    again, _ = join(network, "a")
    network.advance(0)
    assert rb.named("peer")[2:] == [(again.own, True)]


def test_a_restart_is_a_new_peer_and_two_hosts_of_one_name_are_two() -> None:
    network = MemoryNetwork(manual=True)
    (a, _), (_, rb) = pair(network)
    first = a.own
    a.stop()
    a.start("uav1", "a")
    twin, _ = join(network, "a")
    network.advance(0)
    assert rb.named("peer")[1:] == [(first, False), (a.own, True), (twin.own, True)]
    assert len({first, a.own, twin.own}) == 3


def test_vehicles_do_not_mix() -> None:
    network = MemoryNetwork(manual=True)
    _, ra = join(network, "a")
    _, rb = join(network, "b", vehicle="uav2")
    network.advance(1)
    assert ra.events == rb.events == []


def test_data_of_streams_never_announced_is_counted_not_handed_over() -> None:
    network = MemoryNetwork(manual=True)
    (a, _), (b, rb) = pair(network)
    network.set_link("a", "b", delay=10.0)
    a.topic_advertised(replace(ADVERT, topic="gps"))
    network.set_link("a", "b")
    a.send_message(b.own, "gps", 0, SampleHeader(1, 1), b"")
    a.flush()
    network.advance(0)
    assert numbers(rb) == []
    assert b.counters()["unknown"] == 1


def test_a_handler_that_raises_is_counted_and_told_the_rest(caplog: pytest.LogCaptureFixture) -> None:
    class Failing(Recorder):
        def process_control(self, peer: Peer, body: bytes) -> None:
            super().process_control(peer, body)
            raise ValueError("a handler's own fault")

    network = MemoryNetwork(manual=True)
    a, _ = join(network, "a")
    b, handler = network.channel(), Failing()
    b.register_handler(handler)
    b.start("uav1", "b")
    network.advance(0)
    for body in (b"1", b"2"):
        a.send_control(b.own, body)
    a.flush()
    network.advance(0)
    assert [body for _, body in handler.named("control")] == [b"1", b"2"]
    assert b.counters()["handler_errors"] == 2
    assert "a handler's own fault" in caplog.text


def test_misuse_raises_and_a_stopped_channel_does_nothing() -> None:
    network = MemoryNetwork(manual=True)
    channel = network.channel()
    with pytest.raises(ChannelError, match="handler before start"):
        channel.start("uav1", "a")
    channel.register_handler(Recorder())
    with pytest.raises(ChannelError, match="handler already"):
        channel.register_handler(Recorder())
    with pytest.raises(ChannelError, match="not been started"):
        channel.flush()
    with pytest.raises(ChannelError, match="host 'a/b'"):
        channel.start("uav1", "a/b")
    with pytest.raises(ChannelError, match="vehicle ''"):
        channel.start("", "a")
    channel.start("uav1", "a")
    with pytest.raises(ChannelError, match="started already"):
        channel.start("uav1", "a")
    with pytest.raises(ChannelError, match="never advertised"):
        channel.send_message(channel.own, "imu", 0, SampleHeader(1, 1), b"")
    channel.stop()
    channel.stop()
    channel.topic_advertised(ADVERT)
    channel.flush()


@pytest.mark.parametrize("wrong", [{"loss": 1.1}, {"duplicate": -0.1}, {"delay": -1.0}, {"jitter": -1.0}])
def test_links_that_cannot_be_are_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(ValueError):
        MemoryNetwork().set_link("a", "b", **wrong)


def test_real_time_delivers_by_itself_and_its_thread_ends_with_the_last_channel() -> None:
    network = MemoryNetwork(lease=0.05)
    with pytest.raises(RuntimeError):
        network.advance(1)
    (a, ra), (b, rb) = join(network, "a"), join(network, "b")
    assert ra.wait_for("peer", b.own, True)
    network.set_link("a", "b", delay=0.01)
    a.send_control(b.own, b"x")
    a.flush()
    assert rb.wait_for("control", a.own, b"x")
    network.cut("a", "b")
    assert rb.wait_for("peer", a.own, False)
    network.heal("a", "b")
    assert rb.wait(lambda events: events[-1] == ("peer", a.own, True))
    a.stop()
    assert rb.wait(lambda events: events[-1] == ("peer", a.own, False))
    b.stop()
    assert "uorb-memory" not in {thread.name for thread in threading.enumerate()}


def test_a_handler_may_stop_its_channel_and_hears_nothing_after() -> None:
    class Leaving(Recorder):
        channel: MemoryChannel

        def process_peer(self, peer: Peer, present: bool) -> None:
            self.channel.stop()
            super().process_peer(peer, present)

    network = MemoryNetwork()
    handler = Leaving()
    handler.channel = network.channel()
    handler.channel.register_handler(handler)
    handler.channel.start("uav1", "a")
    b, rb = join(network, "b")
    assert rb.wait(lambda events: len(events) == 2)
    expected: list[Event] = [("peer", b.own, True)]
    assert handler.events == expected
    b.stop()
