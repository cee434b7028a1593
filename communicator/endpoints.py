"""Zenoh endpoints, checked before Zenoh sees them: it accepts forms that never connect. No Zenoh here."""

import ipaddress
import re
import socket
from collections.abc import Iterable
from dataclasses import dataclass

from communicator.channel import ChannelError

ENCRYPTED = frozenset({"tls", "quic"})
PROTOCOLS = frozenset({"tcp", "udp", "ws", "unixsock-stream"}) | ENCRYPTED
_DEFAULT_PORT = 7447
_HOST_NAME = re.compile(r"(?!-)[A-Za-z0-9_-]{1,63}(\.[A-Za-z0-9_-]{1,63})*\.?")
_ZONE = re.compile(r"[A-Za-z0-9_.-]{1,32}")


@dataclass(frozen=True, slots=True)
class Endpoint:
    """One checked endpoint; `host` without brackets, or the path of a Unix socket with port 0."""

    text: str
    protocol: str
    host: str
    port: int


def parse_endpoints(what: str, texts: Iterable[str]) -> tuple[Endpoint, ...]:
    """Check the endpoints of the option `what`.

    Raises:
        ChannelError: one is wrong; the message shows the right form.
    """
    if isinstance(texts, str):
        raise ChannelError(f'{what} is a list of endpoints: write {what}=["{texts}"]')
    return tuple(_parse(what, text) for text in texts)


def _parse(what: str, text: object) -> Endpoint:
    if not isinstance(text, str):
        raise ChannelError(f"{what} endpoint {text!r} is not a string")
    protocol, slash, rest = text.partition("/")
    if not slash or protocol not in PROTOCOLS:
        known = ", ".join(sorted(PROTOCOLS))
        raise ChannelError(
            f"{what} endpoint {text!r}: write tcp/<host>:<port>, for example "
            f"tcp/192.168.1.10:{_DEFAULT_PORT}; protocols: {known}"
        )
    address = re.split(r"[?#]", rest, maxsplit=1)[0]
    if protocol == "unixsock-stream":
        if not address.startswith("/"):
            raise ChannelError(f"{what} endpoint {text!r}: write unixsock-stream//absolute/path")
        return Endpoint(text, protocol, address, 0)
    host, port = _split(what, text, protocol, address)
    if port == 0 and what == "connect":
        raise ChannelError(f"{what} endpoint {text!r}: port 0 cannot be connected to")
    return Endpoint(text, protocol, host, port)


def _split(what: str, text: str, protocol: str, address: str) -> tuple[str, int]:
    host, colon, port = address.rpartition(":")
    if address.endswith("]") or not colon:
        raise ChannelError(f"{what} endpoint {text!r} has no port; write {protocol}/{address}:{_DEFAULT_PORT}")
    if ":" in host and not (host.startswith("[") and host.endswith("]")):
        raise ChannelError(
            f"{what} endpoint {text!r}: write an IPv6 address in brackets, with its port: "
            f"{protocol}/[{address}]:{_DEFAULT_PORT}"
        )
    if not re.fullmatch(r"[0-9]{1,5}", port) or int(port) > 0xFFFF:
        raise ChannelError(f"{what} endpoint {text!r}: port {port!r} is not a number from 1 to 65535")
    if not _is_host(host):
        raise ChannelError(f"{what} endpoint {text!r}: {host!r} is no host name or address")
    return host.strip("[]"), int(port)


def _is_host(host: str) -> bool:
    if host.startswith("["):
        address, percent, zone = host[1:-1].partition("%")
        return _ip(address, 6) and (not percent or bool(_ZONE.fullmatch(zone)))
    if re.fullmatch(r"[0-9.]+", host):
        return _ip(host, 4)
    return bool(_HOST_NAME.fullmatch(host))


def _ip(text: str, version: int) -> bool:
    try:
        return ipaddress.ip_address(text).version == version
    except ValueError:
        return False


def without_own(connect: Iterable[Endpoint], listen: Iterable[Endpoint]) -> tuple[Endpoint, ...]:
    """Drop from `connect` what `listen` itself answers, so that all hosts can carry one list.

    Zenoh would try to reach itself for ever. Names are not looked up: a host's own name is known as
    such only if it is `socket.gethostname()`.
    """
    listening = tuple(listen)
    return tuple(e for e in connect if not any(_answers(own, e) for own in listening))


def _answers(own: Endpoint, other: Endpoint) -> bool:
    if (own.protocol, own.port) != (other.protocol, other.port):
        return False
    mine, theirs = _address(own.host), _address(other.host)
    if mine is None or theirs is None:
        return own.host.lower() == other.host.lower()
    if mine == theirs:
        return True
    # A wildcard answers on every address of this machine, [::] on its IPv4 ones too.
    covers = mine.is_unspecified and (mine.version == 6 or theirs.version == 4)
    return covers and (theirs.is_unspecified or _is_local(theirs))


def _address(host: str) -> ipaddress.IPv4Address | ipaddress.IPv6Address | None:
    if host.lower() == "localhost":
        host = "127.0.0.1"
    elif host.lower() == socket.gethostname().lower():
        host = "127.0.1.1"  # a loopback address no one lists: "this machine, whichever way"
    try:
        return ipaddress.ip_address(host)
    except ValueError:
        return None


def _is_local(address: ipaddress.IPv4Address | ipaddress.IPv6Address) -> bool:
    if address.is_loopback:
        return True
    family = socket.AF_INET6 if address.version == 6 else socket.AF_INET
    try:
        # Only an address of this machine can be bound; nothing is sent.
        with socket.socket(family, socket.SOCK_DGRAM) as probe:
            probe.bind((str(address), 0))
    except OSError:
        return False
    return True
