"""Channels over real Zenoh sessions in one process: everything the verbs promise, in mesh and hub."""

import shutil
import socket
import subprocess
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing
from dataclasses import replace
from itertools import count
from pathlib import Path

import pytest

from communicator import Advert, ChannelError, Peer, SampleHeader, ZenohChannel, token_reader
from communicator.recorder import Recorder
from communicator.wire import MAX_PAYLOAD, pack_control_header, pack_frame_header

ADVERT = Advert("imu", 0, "px4_msgs/msg/Imu", "RIHS01_" + "0" * 64, 52, 1, 50, True)
LEASE = 0.6
_vehicles = count()


def free_port() -> int:
    """A port nobody listens on just now."""
    with closing(socket.socket()) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


class Host:
    """A started channel and its handler."""

    def __init__(self, name: str, vehicle: str, handler: Recorder, channel: ZenohChannel) -> None:
        self.handler = handler
        self.channel = channel
        channel.register_handler(handler)
        channel.start(vehicle, name)

    @property
    def own(self) -> Peer:
        return self.channel.own

    def sees(self, other: "Host") -> bool:
        return self.handler.wait_for("peer", other.own, True)

    def send(self, to: "Host", number: int, payload: bytes, topic: str = "imu") -> None:
        self.channel.send_message(to.own, topic, 0, SampleHeader(number, 0), payload)
        self.channel.flush()

    def got(self, number: int, timeout: float = 10.0) -> bytes | None:
        """Wait for the sample of this number and return its payload."""

        def find() -> list[bytes]:
            samples = self.handler.named("received_message")
            return [p for *_, h, p in samples if isinstance(h, SampleHeader) and isinstance(p, bytes)
                    and h.sequence == number]  # fmt: skip

        self.handler.wait(lambda _: find(), timeout)
        return next(iter(find()), None)


class Net:
    """Starts hosts of one vehicle, and stops whatever a test left running."""

    def __init__(self) -> None:
        self.port = free_port()
        self.endpoint = f"tcp/127.0.0.1:{self.port}"
        self.vehicle = f"uav{next(_vehicles)}"
        self.hosts: list[Host] = []

    def host(
        self,
        name: str,
        handler: Recorder | None = None,
        *,
        listen: tuple[str, ...] = (),
        connect: tuple[str, ...] = (),
        mode: str = "peer",
        vehicle: str | None = None,
        tls: Mapping[str, str] | None = None,
    ) -> Host:
        channel = ZenohChannel(listen=listen, connect=connect, mode=mode, lease=LEASE, tls=tls)
        host = Host(name, vehicle or self.vehicle, handler or Recorder(), channel)
        self.hosts.append(host)
        return host

    def pair(self) -> tuple[Host, Host]:
        """Two hosts that see each other, each advertising imu."""
        a = self.host("a", listen=(self.endpoint,))
        b = self.host("b", connect=(self.endpoint,))
        for host, other in ((a, b), (b, a)):
            host.channel.topic_advertised(ADVERT)
            assert other.handler.wait_for("remote_topic", host.own, ADVERT, True)
        return a, b


@pytest.fixture
def net() -> Iterator[Net]:
    made = Net()
    yield made
    for host in made.hosts:
        host.channel.stop()
    names = {thread.name for thread in threading.enumerate()}
    assert not {name for name in names if name.startswith("uorb-zenoh")}


class Proxy:
    """A TCP relay that can fall silent while every socket stays open: a silent cut."""

    def __init__(self, target: int) -> None:
        self.target = target
        self.open = threading.Event()
        self.open.set()
        self.server = socket.create_server(("127.0.0.1", 0))
        self.port = int(self.server.getsockname()[1])
        self.sockets: list[socket.socket] = []
        threading.Thread(target=self._accept, daemon=True).start()

    def _accept(self) -> None:
        try:
            while True:
                near = self.server.accept()[0]
                far = socket.create_connection(("127.0.0.1", self.target))
                self.sockets += (near, far)
                for pipe in ((near, far), (far, near)):
                    threading.Thread(target=self._pump, args=pipe, daemon=True).start()
        except OSError:
            return

    def _pump(self, source: socket.socket, sink: socket.socket) -> None:
        try:
            while data := source.recv(65536):
                self.open.wait()
                sink.sendall(data)
            self.open.wait()
            sink.shutdown(socket.SHUT_WR)
        except OSError:
            return

    def close(self) -> None:
        self.open.set()
        self.server.shutdown(socket.SHUT_RDWR)
        for each in (self.server, *self.sockets):
            each.close()


@pytest.fixture
def proxy(net: Net) -> Iterator[Proxy]:
    made = Proxy(net.port)
    yield made
    made.close()


def test_start_returns_at_once_and_peers_see_each_other_with_their_own_ids(net: Net) -> None:
    began = time.monotonic()
    b = net.host("b", connect=(net.endpoint,))  # nobody is there yet
    assert time.monotonic() - began < 1.0
    a = net.host("a", listen=(net.endpoint,))
    assert a.sees(b)
    assert b.sees(a)
    assert a.own.instance_id != b.own.instance_id


def test_every_host_can_carry_the_same_list_of_endpoints(net: Net) -> None:
    endpoints = tuple(f"tcp/127.0.0.1:{free_port()}" for _ in range(3))
    hosts = [net.host(f"h{n}", listen=(own,), connect=endpoints) for n, own in enumerate(endpoints)]
    for host in hosts:
        assert all(host.sees(other) for other in hosts if other is not host)
        assert len(host.handler.named("peer")) == 2


def test_adverts_come_change_and_go(net: Net) -> None:
    a, b = net.pair()
    deeper = replace(ADVERT, queue_length=8)
    a.channel.topic_advertised(deeper)
    assert b.handler.wait_for("remote_topic", a.own, deeper, True)
    a.channel.topic_unadvertised("imu", 0)
    assert b.handler.wait_for("remote_topic", a.own, deeper, False)
    assert len(b.handler.named("remote_topic")) == 3


def test_a_rate_change_is_no_moment_without_a_subscription(net: Net) -> None:
    a, b = net.pair()
    for interval_us in (1000, 0, 5000):
        b.channel.add_subscription(a.own, "imu", 0, interval_us)
        assert a.handler.wait_for("add_subscription", b.own, "imu", 0, interval_us)
    assert not a.handler.named("remove_subscription")
    b.channel.remove_subscription(a.own, "imu", 0)
    assert a.handler.wait_for("remove_subscription", b.own, "imu", 0)
    assert [event[-1] for event in a.handler.named("add_subscription")] == [1000, 0, 5000]


def test_a_subscription_to_what_a_peer_does_not_have_is_nothing(net: Net) -> None:
    a, b = net.pair()
    b.channel.add_subscription(a.own, "no_such_topic", 0, 0)
    b.channel.add_subscription(Peer("ghost", "0" * 16), "imu", 0, 0)
    b.channel.add_subscription(a.own, "imu", 0, 7)
    assert a.handler.wait_for("add_subscription", b.own, "imu", 0, 7)
    assert len(a.handler.named("add_subscription")) == 1
    assert a.channel.counters()["malformed"] == 0


@pytest.mark.parametrize(("queue_length", "size"), [(1, 52), (8, 52), (1, 40_000), (1, 1 << 20), (4, 8 << 20)])
def test_samples_of_every_class_and_size_cross_both_ways(net: Net, queue_length: int, size: int) -> None:
    a, b = net.pair()
    sized = replace(ADVERT, topic="sized", queue_length=queue_length, payload_length=size)
    payload = bytes(range(256)) * (size // 256 + 1)
    for host, other in ((a, b), (b, a)):
        host.channel.topic_advertised(sized)
        assert other.handler.wait_for("remote_topic", host.own, sized, True)
        for number in range(1, 11):  # what is larger than the sockets' buffers may be dropped
            host.send(other, number, payload[:size], "sized")
            if (received := other.got(number, timeout=2.0)) is not None:
                break
        assert received == payload[:size]


def test_a_sample_keeps_its_header_and_control_its_bytes(net: Net) -> None:
    a, b = net.pair()
    now_us = time.monotonic_ns() // 1000
    header = SampleHeader(2**63, now_us - 5_000_000, withheld=3, latched=True)
    a.channel.send_message(b.own, "imu", 0, header, b"x")
    a.channel.send_control(b.own, b"\x00any bytes")
    a.channel.flush()
    assert b.handler.wait_for("control", a.own, b"\x00any bytes")
    assert b.got(2**63) == b"x"
    peer, topic, instance, received, _ = b.handler.named("received_message")[0]
    assert (peer, topic, instance) == (a.own, "imu", 0)
    assert isinstance(received, SampleHeader)
    assert 5_000_000 <= received.age_us < 10_000_000
    assert replace(received, age_us=0) == header


def test_five_hundred_adverts_at_once_all_arrive(net: Net) -> None:
    a, b = net.pair()
    adverts = [replace(ADVERT, topic=f"topic_{n}", instance=n % 4) for n in range(500)]
    for advert in adverts:
        a.channel.topic_advertised(advert)
    expected = {(a.own, advert, True) for advert in (ADVERT, *adverts)}
    assert b.handler.wait(lambda events: sum(e[0] == "remote_topic" for e in events) == 501)
    assert set(b.handler.named("remote_topic")) == expected
    late = net.host("late", connect=(net.endpoint,))
    assert late.handler.wait(lambda events: sum(e[0] == "remote_topic" for e in events) == 501)
    assert late.handler.events[0] == ("peer", a.own, True)


def test_the_first_sample_after_a_subscription_is_seen_arrives_every_time(net: Net) -> None:
    class Answering(Recorder):
        """Sends the newest sample to whoever subscribes, as a link does."""

        host: Host

        def process_add_subscription(self, peer: Peer, topic: str, instance: int, interval_us: int) -> None:
            header = SampleHeader(interval_us, 0, latched=True)
            self.host.channel.send_message(peer, topic, instance, header, b"newest")
            self.host.channel.flush()

    handler = Answering()
    handler.host = a = net.host("a", handler, listen=(net.endpoint,))
    a.channel.topic_advertised(ADVERT)
    for number in range(1, 9):
        b = net.host("b", connect=(net.endpoint,))
        assert b.handler.wait_for("remote_topic", a.own, ADVERT, True)
        b.channel.add_subscription(a.own, "imu", 0, number)
        assert b.got(number) == b"newest"
        b.channel.stop()


def test_other_vehicles_are_not_heard(net: Net) -> None:
    a, b = net.pair()
    stranger = net.host("a", connect=(net.endpoint,), vehicle=net.vehicle + "x")
    stranger.channel.topic_advertised(ADVERT)
    c = net.host("c", connect=(net.endpoint,))
    assert a.sees(c)
    assert {event[0] for event in a.handler.named("peer")} == {b.own, c.own}
    assert stranger.handler.events == []


def test_garbage_from_a_raw_session_is_counted_and_good_data_goes_on(net: Net) -> None:
    import zenoh

    a, b = net.pair()
    config = zenoh.Config.from_json5(
        '{mode: "peer", listen: {endpoints: []}, scouting: {multicast: {enabled: false}, delay: 0},'
        f'connect: {{endpoints: ["{net.endpoint}"]}}}}'
    )
    prefix, ident = f"uorb/{net.vehicle}", "00000000000000ff"
    stranger = pack_frame_header(bytes.fromhex(ident), 1) + pack_control_header(2) + b"hi"
    spoilt = pack_frame_header(bytes.fromhex(b.own.instance_id), 1) + b"\x07garbage"
    with zenoh.open(config) as raw:
        there = raw.liveliness().declare_subscriber(f"{prefix}/@host/a/**", history=True)
        assert there.recv().kind == zenoh.SampleKind.PUT  # connected: what is put now arrives
        tokens = [
            raw.liveliness().declare_token(f"{prefix}/{tail}")
            for tail in (
                f"@host/mallory/{ident}/one",
                f"@host/mallory/{ident}",
                f"@host/mallory/{b.own.instance_id}/1",  # an id that is taken
                f"@adv/b/{b.own.instance_id}/0/other/0/T/h/1/1/1/s",  # a stream that is taken
                f"@adv/mallory/{ident}/1/x",
                f"@sub/{a.own.instance_id}/b/{b.own.instance_id}/9/imu/0/0",  # a stream there is not
                f"@host/future/{ident}/2",
            )
        ]
        assert len(tokens) == 7
        for traffic in ("c", "s", "b"):
            for payload in (b"", b"garbage", spoilt, stranger, bytes(100_000)):
                key = f"{prefix}/{traffic}/{a.own.instance_id}"
                raw.put(key, payload, congestion_control=zenoh.CongestionControl.BLOCK)
            raw.delete(f"{prefix}/{traffic}/{a.own.instance_id}")
        until(lambda: a.channel.counters()["malformed"] == 6 + 3 * 5)
        until(lambda: a.channel.counters()["unknown"] == 3)
        until(lambda: a.channel.counters()["incompatible"] == 1)
        b.send(a, 1, b"good")
        assert a.got(1) == b"good"
    assert [event[0] for event in a.handler.events] == ["peer", "remote_topic", "received_message"]
    assert a.channel.counters()["panics"] == a.channel.counters()["handler_errors"] == 0


def until(done: Callable[[], bool], timeout: float = 10.0) -> None:
    """Wait for a counter, which has no event to wait on."""
    deadline = time.monotonic() + timeout
    while not done():
        assert time.monotonic() < deadline
        threading.Event().wait(0.005)


def test_a_port_in_use_is_an_error_that_names_it(net: Net) -> None:
    net.host("a", listen=(net.endpoint,))
    late = ZenohChannel(listen=[net.endpoint])
    late.register_handler(Recorder())
    with pytest.raises(ChannelError, match=rf"{net.endpoint}: the port is in use"):
        late.start(net.vehicle, "late")
    net.hosts[0].channel.stop()
    late.start(net.vehicle, "late")  # the same channel can try again
    late.stop()


def test_a_client_starts_without_its_router_and_stops_without_it(net: Net) -> None:
    began = time.monotonic()
    lonely = net.host("lonely", mode="client", connect=(net.endpoint,))
    lonely.channel.topic_advertised(ADVERT)
    assert time.monotonic() - began < 0.5
    lonely.channel.stop()
    assert time.monotonic() - began < 2.5


@pytest.mark.parametrize("mode", ["router", "peer"])
def test_clients_hear_each_other_through_a_hub_that_comes_later(net: Net, mode: str) -> None:
    clients = [net.host(name, mode="client", connect=(net.endpoint,)) for name in ("x", "y")]
    for client in clients:
        client.channel.topic_advertised(ADVERT)
    hub = net.host("hub", mode=mode, listen=(net.endpoint,))
    x, y = clients
    assert hub.sees(x)
    for host, other in ((x, y), (y, x)):
        assert host.handler.wait_for("remote_topic", other.own, ADVERT, True)
        host.channel.add_subscription(other.own, "imu", 0, 0)
        assert other.handler.wait_for("add_subscription", host.own, "imu", 0, 0)
        other.send(host, 1, b"via hub")
        assert host.got(1) == b"via hub"


def test_a_silent_peer_is_lost_after_the_lease_and_comes_back_with_all_it_announced(net: Net, proxy: Proxy) -> None:
    a = net.host("a", listen=(net.endpoint,))
    b = net.host("b", connect=(f"tcp/127.0.0.1:{proxy.port}",))
    a.channel.topic_advertised(ADVERT)
    assert b.handler.wait_for("remote_topic", a.own, ADVERT, True)
    b.channel.add_subscription(a.own, "imu", 0, 9)
    assert a.handler.wait_for("add_subscription", b.own, "imu", 0, 9)
    proxy.open.clear()
    began = time.monotonic()
    assert a.handler.wait_for("peer", b.own, False)
    assert b.handler.wait_for("peer", a.own, False)
    assert 0.5 * LEASE < time.monotonic() - began < 3 * LEASE
    a.channel.topic_advertised(replace(ADVERT, topic="gps"))
    a.handler.clear()
    b.handler.clear()
    proxy.open.set()
    assert b.handler.wait_for("remote_topic", a.own, replace(ADVERT, topic="gps"), True)
    assert b.handler.wait_for("remote_topic", a.own, ADVERT, True)
    assert b.handler.events[0] == ("peer", a.own, True)
    assert a.handler.wait_for("peer", b.own, True)
    b.channel.add_subscription(a.own, "imu", 0, 9)
    assert a.handler.wait_for("add_subscription", b.own, "imu", 0, 9)
    a.send(b, 1, b"again")
    assert b.got(1) == b"again"


def test_a_cut_shorter_than_the_lease_is_no_news(net: Net, proxy: Proxy) -> None:
    a = net.host("a", listen=(net.endpoint,))
    b = net.host("b", connect=(f"tcp/127.0.0.1:{proxy.port}",))
    assert a.sees(b)
    assert b.sees(a)
    proxy.open.clear()
    a.channel.topic_advertised(ADVERT)
    assert not b.handler.wait_for("remote_topic", a.own, ADVERT, True, timeout=LEASE / 4)
    proxy.open.set()
    assert b.handler.wait_for("remote_topic", a.own, ADVERT, True)
    assert len(a.handler.named("peer")) == len(b.handler.named("peer")) == 1


@pytest.fixture
def certificates(tmp_path: Path) -> Callable[[str], dict[str, str]]:
    """Returns a maker of a host's files, all signed by one authority."""
    if shutil.which("openssl") is None:
        pytest.skip("needs openssl")

    def openssl(*args: str) -> None:
        subprocess.run(["openssl", *args], cwd=tmp_path, check=True, capture_output=True, timeout=20)

    key = ("-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:P-256", "-nodes")
    openssl("req", "-x509", *key, "-keyout", "ca.key", "-out", "ca.pem", "-subj", "/CN=ca", "-days", "2")
    (tmp_path / "san").write_text("subjectAltName=IP:127.0.0.1\n")

    def make(host: str) -> dict[str, str]:
        openssl("req", *key, "-keyout", f"{host}.key", "-out", f"{host}.csr", "-subj", f"/CN={host}")
        signed = ("-CA", "ca.pem", "-CAkey", "ca.key", "-CAcreateserial", "-days", "2", "-extfile", "san")
        openssl("x509", "-req", "-in", f"{host}.csr", "-out", f"{host}.pem", *signed)
        names = {"ca": "ca.pem", "certificate": f"{host}.pem", "key": f"{host}.key"}
        return {option: str(tmp_path / name) for option, name in names.items()}

    return make


def test_tls_hosts_hear_each_other(net: Net, certificates: Callable[[str], dict[str, str]]) -> None:
    endpoint = f"tls/127.0.0.1:{net.port}"
    a = net.host("a", listen=(endpoint,), tls=certificates("a"))
    b = net.host("b", connect=(endpoint,), tls=certificates("b"))
    assert a.sees(b)
    assert b.sees(a)
    b.channel.topic_advertised(ADVERT)
    assert a.handler.wait_for("remote_topic", b.own, ADVERT, True)
    b.send(a, 1, b"secret")
    assert a.got(1) == b"secret"


def test_a_restart_is_a_new_peer_of_the_same_host(net: Net) -> None:
    a, b = net.pair()
    before = b.own
    b.channel.stop()
    assert a.handler.wait_for("peer", before, False)
    b.channel.start(net.vehicle, "b")
    assert b.own != before
    assert a.sees(b)
    assert b.handler.wait(lambda events: events.count(("remote_topic", a.own, ADVERT, True)) == 2)
    a.send(b, 1, b"to the new one")
    assert b.got(1) == b"to the new one"


def test_no_call_comes_after_stop_and_stop_is_quick_under_load(net: Net) -> None:
    a, b = net.pair()
    ended = threading.Event()

    def flood() -> None:
        for number in range(1, 10**9):
            if ended.is_set():
                return
            a.send(b, number, bytes(100))

    sender = threading.Thread(target=flood)
    sender.start()
    assert b.handler.wait(lambda events: len(events) > 50)  # any 50: a flood may lose some
    began = time.monotonic()
    b.channel.stop()
    assert time.monotonic() - began < 2.0
    told = len(b.handler.events)
    assert a.handler.wait_for("peer", b.own, False)
    assert len(b.handler.events) == told
    a.channel.stop()  # under a sender: its calls turn into nothing
    ended.set()
    sender.join(5)
    assert a.channel.counters()["send_errors"] == 0


def test_a_panic_on_a_channel_thread_is_counted_and_the_thread_lives(
    net: Net, caplog: pytest.LogCaptureFixture
) -> None:
    class Panic(BaseException):
        """Like PyO3's PanicException, it is no Exception."""

    class Panicking(Recorder):
        def process_control(self, peer: Peer, body: bytes) -> None:
            if body == b"panic":
                raise Panic("rust")
            super().process_control(peer, body)

        def process_peer(self, peer: Peer, present: bool) -> None:
            super().process_peer(peer, present)
            raise Panic("news")

    a = net.host("a", Panicking(), listen=(net.endpoint,))
    b = net.host("b", connect=(net.endpoint,))
    assert a.sees(b)
    assert b.sees(a)
    b.channel.topic_advertised(ADVERT)
    assert a.handler.wait_for("remote_topic", b.own, ADVERT, True)
    for body in (b"panic", b"after"):
        b.channel.send_control(a.own, body)
        b.channel.flush()
    assert a.handler.wait_for("control", b.own, b"after")
    assert a.channel.counters()["panics"] == 2
    assert "goes on" in caplog.text


def test_oversized_payloads_are_counted_and_not_sent(net: Net) -> None:
    a, b = net.pair()
    a.send(b, 1, bytes(MAX_PAYLOAD + 1))
    a.channel.send_control(b.own, bytes(MAX_PAYLOAD + 1))
    a.send(b, 2, b"fits")
    assert b.got(2) == b"fits"
    assert a.channel.counters()["oversized"] == 2
    assert len(b.handler.named("received_message")) == 1


def test_a_token_ring_that_ran_over_is_made_good(net: Net, monkeypatch: pytest.MonkeyPatch) -> None:
    gate = threading.Event()

    class Stalled(Recorder):
        def process_remote_topic(self, peer: Peer, advert: Advert, advertised: bool) -> None:
            assert gate.wait(10)
            super().process_remote_topic(peer, advert, advertised)

    a = net.host("a", listen=(net.endpoint,))
    monkeypatch.setattr(token_reader, "RING", 32)
    monkeypatch.setattr("communicator.zenoh_node._NEWS", 8)
    b = net.host("b", Stalled(), connect=(net.endpoint,))
    assert a.sees(b)
    adverts = [replace(ADVERT, topic=f"topic_{n}") for n in range(300)]
    for advert in adverts:
        a.channel.topic_advertised(advert)
    for advert in adverts[::3]:
        a.channel.topic_unadvertised(advert.topic, 0)
    a.channel.send_control(b.own, b"all said")
    a.channel.flush()
    assert b.handler.wait_for("control", a.own, b"all said")
    gate.set()
    expected = {advert for advert in adverts if advert not in adverts[::3]}

    def shown() -> set[object]:
        last = {args[1]: args[2] for args in b.handler.named("remote_topic")}
        return {advert for advert, advertised in last.items() if advertised}

    assert b.handler.wait(lambda _: shown() == expected)
    assert b.channel.counters()["resyncs"] >= 1
