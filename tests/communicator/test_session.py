"""Options are checked before Zenoh sees them, and each complaint shows how to write it right."""

import socket
import subprocess
import sys
from collections.abc import Mapping

import pytest

from communicator import ChannelError, ZenohChannel
from communicator.endpoints import parse_endpoints, without_own
from communicator.session import SessionOptions, build_config, check_files, check_options


def options(
    *,
    listen: tuple[str, ...] = (),
    connect: tuple[str, ...] = (),
    mode: str = "peer",
    tls: Mapping[str, str] | None = None,
    config: Mapping[str, object] | None = None,
) -> SessionOptions:
    """Checked options, the rest as by default."""
    return check_options(listen=listen, connect=connect, mode=mode, lease=2.0, tls=tls, multicast=False, config=config)


@pytest.mark.parametrize(
    "endpoint",
    [
        "tcp/127.0.0.1:7447",
        "tcp/companion.local:7447",
        "tcp/[::1]:7447",
        "tcp/[fe80::1%eth0]:7447",
        "udp/10.0.0.1:1",
        "tcp/0.0.0.0:65535#so_sndbuf=65536",
        "tcp/10.0.0.1:7447?rel=0;prio=1-3",
        "unixsock-stream//run/uorb.sock",
        "ws/host:80",
    ],
)
def test_good_endpoints_pass(endpoint: str) -> None:
    assert [e.text for e in parse_endpoints("connect", [endpoint])] == [endpoint]


@pytest.mark.parametrize(
    ("endpoint", "advice"),
    [
        ("tcp/1.2.3.4", r"no port; write tcp/1\.2\.3\.4:7447"),
        ("tcp/[::1]", r"no port; write tcp/\[::1\]:7447"),
        ("tcp/fe80::1:7447", "in brackets"),
        ("tcp/::1", "in brackets"),
        ("1.2.3.4:7447", "write tcp/<host>:<port>"),
        ("sctp/1.2.3.4:7447", "protocols: quic, tcp"),
        ("tcp/1.2.3.4:http", "port 'http'"),
        ("tcp/1.2.3.4:65536", "port '65536'"),
        ("tcp/1.2.3.4:", "port ''"),
        ("tcp/1.2.3.4:0", "port 0"),
        ("tcp/1.2.3.999:7447", "no host name or address"),
        ("tcp/:7447", "no host name or address"),
        ("tcp/[::zz]:7447", "no host name or address"),
        ("tcp/a host:7447", "no host name or address"),
        ("unixsock-stream/relative", "absolute"),
        ("", "write tcp/<host>:<port>"),
    ],
)
def test_bad_endpoints_are_refused_with_the_right_form(endpoint: str, advice: str) -> None:
    with pytest.raises(ChannelError, match=advice):
        ZenohChannel(connect=[endpoint])


def test_one_string_is_not_a_list_of_endpoints() -> None:
    with pytest.raises(ChannelError, match=r'write listen=\["tcp/1\.2\.3\.4:5"\]'):
        ZenohChannel(listen="tcp/1.2.3.4:5")


@pytest.mark.parametrize(
    ("listen", "connect", "kept"),
    [
        ("tcp/127.0.0.1:7447", "tcp/127.0.0.1:7447", False),
        ("tcp/127.0.0.1:7447", "tcp/localhost:7447", False),
        ("tcp/0.0.0.0:7447", "tcp/127.0.0.1:7447", False),
        ("tcp/0.0.0.0:7447", "tcp/0.0.0.0:7447", False),
        ("tcp/0.0.0.0:7447", f"tcp/{socket.gethostname()}:7447", False),
        ("tcp/[::]:7447", "tcp/[::1]:7447", False),
        ("tcp/[::]:7447", "tcp/127.0.0.1:7447", False),
        ("tcp/companion:7447", "tcp/Companion:7447", False),
        ("tcp/0.0.0.0:7447", "tcp/127.0.0.1:7448", True),
        ("tcp/0.0.0.0:7447", "udp/127.0.0.1:7447", True),
        ("tcp/0.0.0.0:7447", "tcp/192.0.2.77:7447", True),
        ("tcp/0.0.0.0:7447", "tcp/[::1]:7447", True),
        ("tcp/0.0.0.0:7447", "tcp/other-host:7447", True),
        ("tcp/127.0.0.1:7447", "tcp/192.0.2.77:7447", True),
    ],
)
def test_only_ones_own_endpoint_is_left_out(listen: str, connect: str, kept: bool) -> None:
    others = without_own(parse_endpoints("connect", [connect]), parse_endpoints("listen", [listen]))
    assert bool(others) is kept


@pytest.mark.parametrize("lease", [0.0, -1.0, float("nan"), float("inf"), 1e9])
def test_a_lease_that_is_no_lease_is_refused(lease: float) -> None:
    with pytest.raises(ChannelError, match="lease"):
        ZenohChannel(lease=lease)


def test_modes_that_cannot_work_are_refused() -> None:
    with pytest.raises(ChannelError, match="peer, client, router"):
        ZenohChannel(mode="server")
    with pytest.raises(ChannelError, match="does not listen"):
        options(mode="client", listen=("tcp/0.0.0.0:7447",), connect=("tcp/a:7447",))
    with pytest.raises(ChannelError, match="router's endpoint"):
        options(mode="client")


FILES = {"ca": "/no/ca.pem", "certificate": "/no/host.pem", "key": "/no/host.key"}


def test_tls_is_whole_and_everywhere_or_not_at_all() -> None:
    with pytest.raises(ChannelError, match="keys ca, certificate, key"):
        options(tls={"ca": "ca.pem"})
    with pytest.raises(ChannelError, match="keys ca, certificate, key"):
        options(tls=FILES | {"password": "x"})
    with pytest.raises(ChannelError, match="not encrypted"):
        options(tls=FILES, listen=("tcp/0.0.0.0:7447",))
    with pytest.raises(ChannelError, match="needs tls="):
        options(listen=("tls/0.0.0.0:7447",))


def test_tls_is_mutual_and_its_files_are_named_when_missing() -> None:
    checked = options(tls=FILES, listen=("tls/0.0.0.0:7447",))
    link = build_config(checked, "a")["transport"]["link"]
    assert link["protocols"] == ["quic", "tls"]
    assert link["tls"]["enable_mtls"] is True
    with pytest.raises(ChannelError, match=r"tls ca '/no/ca\.pem': No such file"):
        check_files(checked)


def test_config_is_merged_last_and_deep() -> None:
    over: dict[str, object] = {"transport": {"link": {"tx": {"lease": 5000}}}, "namespace": "x"}
    built = build_config(options(config=over), "a")
    assert built["transport"]["link"]["tx"]["lease"] == 5000
    assert built["transport"]["link"]["rx"]["max_message_size"] > 64 << 20
    assert built["namespace"] == "x"


def test_config_that_is_no_json_is_refused() -> None:
    with pytest.raises(ChannelError, match="JSON"):
        ZenohChannel(config={"mode": object()})


def test_a_key_zenoh_does_not_know_is_refused_at_start() -> None:
    from communicator.recorder import Recorder

    channel = ZenohChannel(config={"nonsense": 1})
    channel.register_handler(Recorder())
    with pytest.raises(ChannelError, match="nonsense"):
        channel.start("uav1", "a")


def test_importing_the_package_and_making_a_channel_imports_no_zenoh() -> None:
    code = (
        "import sys, communicator; assert not {'communicator.memory', 'json'} & set(sys.modules);"
        "from communicator import ZenohChannel, MemoryNetwork;"
        "ZenohChannel(listen=['tcp/127.0.0.1:7447']); MemoryNetwork().channel();"
        "assert 'zenoh' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=30)
