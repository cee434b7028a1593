"""The liveliness tokens that announce hosts, topics and subscriptions, and the keys of data. No I/O.

Whatever a token says stands in its key: tokens carry no payload, and two equal keys are one token.
"""

import re
from dataclasses import dataclass
from urllib.parse import quote, unquote

from communicator.channel import Advert, ChannelError, Peer
from communicator.wire import WIRE_VERSION, WireError

MAX_STREAM = 0xFFFF
MAX_INSTANCE = 255
MAX_INTERVAL_US = 0xFFFFFFFF
KINDS = ("@host", "@adv", "@sub")
_MAX_KEY = 1024
_NAME = re.compile(r"[A-Za-z0-9_.-]{1,64}")
_HASH = re.compile(r"[A-Za-z0-9_.-]{1,128}")
_ID = re.compile(r"[0-9a-f]{16}")
_DECIMAL = re.compile(r"0|[1-9][0-9]{0,9}")
_TYPE_NAME = re.compile(r"[!-~]{1,255}")


@dataclass(frozen=True, slots=True)
class HostToken:
    """A link is there, and speaks this version of the wire."""

    peer: Peer
    version: int = WIRE_VERSION


@dataclass(frozen=True, slots=True)
class AdvertToken:
    """A peer advertises; its data records say `stream` instead of topic and instance."""

    peer: Peer
    stream: int
    advert: Advert


@dataclass(frozen=True, slots=True)
class SubscriptionToken:
    """`peer` wants the topic instance that `publisher_id` announced as `stream`."""

    publisher_id: str
    peer: Peer
    stream: int
    topic: str
    instance: int
    interval_us: int


Token = HostToken | AdvertToken | SubscriptionToken


def check_name(what: str, name: str) -> str:
    """Return `name` if it can stand in a key.

    Raises:
        ChannelError: it cannot.
    """
    if not _NAME.fullmatch(name):
        raise ChannelError(f"{what} {name!r}: use 1 to 64 letters, digits, '_', '.' or '-'")
    return name


def check_advert(advert: Advert) -> Advert:
    """Return `advert` if every field can stand in a key.

    Raises:
        ChannelError: one cannot; it is named.
    """
    check_name("topic", advert.topic)
    _check_range("instance", advert.instance, MAX_INSTANCE)
    _check_range("payload_length", advert.payload_length, 0xFFFFFFFF)
    _check_range("queue_length", advert.queue_length, 0xFFFF)
    _check_range("priority", advert.priority, 255)
    if not _TYPE_NAME.fullmatch(advert.type_name):
        raise ChannelError(f"type name {advert.type_name!r}: use 1 to 255 printable ASCII characters")
    if not _HASH.fullmatch(advert.type_hash):
        raise ChannelError(f"type hash {advert.type_hash!r}: use 1 to 128 letters, digits, '_', '.' or '-'")
    return advert


def check_interval(interval_us: int) -> int:
    """Return `interval_us` if it can stand in a key, else raise ChannelError."""
    _check_range("interval_us", interval_us, MAX_INTERVAL_US)
    return interval_us


def _check_range(what: str, value: int, top: int) -> None:
    if not 0 <= value <= top:
        raise ChannelError(f"{what} {value}: must be 0 to {top}")


def data_key(vehicle: str, traffic: str, peer_id: str) -> str:
    """Return the key of frames of one traffic class for one peer."""
    return f"uorb/{vehicle}/{traffic}/{peer_id}"


def token_filter(vehicle: str, kind: str, own_id: str) -> str:
    """Return the key expression of all tokens of a kind that concern the link `own_id`."""
    return f"uorb/{vehicle}/@sub/{own_id}/**" if kind == "@sub" else f"uorb/{vehicle}/{kind}/**"


def format_token(vehicle: str, token: Token) -> str:
    """Return the key of a token whose parts have been checked."""
    prefix = f"uorb/{vehicle}"
    peer = f"{token.peer.host}/{token.peer.instance_id}"
    match token:
        case HostToken(_, version):
            return f"{prefix}/@host/{peer}/{version}"
        case AdvertToken(_, stream, a):
            flag = "s" if a.shared else "o"
            kind = f"{quote(a.type_name, safe='')}/{a.type_hash}"
            sizes = f"{a.payload_length}/{a.queue_length}/{a.priority}/{flag}"
            return f"{prefix}/@adv/{peer}/{stream}/{a.topic}/{a.instance}/{kind}/{sizes}"
        case SubscriptionToken(publisher_id, _, stream, topic, instance, interval_us):
            return f"{prefix}/@sub/{publisher_id}/{peer}/{stream}/{topic}/{instance}/{interval_us}"


def parse_token(vehicle: str, key: str) -> Token:
    """Read a token's key.

    Raises:
        WireError: the key is not one that `format_token` writes.
    """
    if len(key) > _MAX_KEY or not key.isascii():
        raise WireError("token key too long or not ASCII")
    root, name, kind, *chunks = [*key.split("/"), "", ""]
    if root != "uorb" or name != vehicle:
        raise WireError("token of another vehicle")
    parse = {"@host": _parse_host, "@adv": _parse_advert, "@sub": _parse_subscription}.get(kind)
    if parse is None:
        raise WireError(f"token kind {kind!r}")
    return parse(chunks[:-2])


def _parse_host(chunks: list[str]) -> Token:
    if len(chunks) != 3:
        raise WireError(f"@host token of {len(chunks)} parts")
    return HostToken(_peer(*chunks[:2]), _number(chunks[2], 0xFFFF))


def _parse_advert(chunks: list[str]) -> Token:
    if len(chunks) != 11:
        raise WireError(f"@adv token of {len(chunks)} parts")
    host, peer_id, stream, topic, instance, type_name, type_hash, length, queue, priority, flag = chunks
    if flag not in {"s", "o"}:
        raise WireError(f"@adv token with flag {flag!r}")
    advert = Advert(
        topic=_match(_NAME, topic),
        instance=_number(instance, MAX_INSTANCE),
        type_name=_type_name(type_name),
        type_hash=_match(_HASH, type_hash),
        payload_length=_number(length, 0xFFFFFFFF),
        queue_length=_number(queue, 0xFFFF),
        priority=_number(priority, 255),
        shared=flag == "s",
    )
    return AdvertToken(_peer(host, peer_id), _number(stream, MAX_STREAM), advert)


def _parse_subscription(chunks: list[str]) -> Token:
    if len(chunks) != 7:
        raise WireError(f"@sub token of {len(chunks)} parts")
    publisher_id, host, peer_id, stream, topic, instance, interval = chunks
    return SubscriptionToken(
        publisher_id=_match(_ID, publisher_id),
        peer=_peer(host, peer_id),
        stream=_number(stream, MAX_STREAM),
        topic=_match(_NAME, topic),
        instance=_number(instance, MAX_INSTANCE),
        interval_us=_number(interval, MAX_INTERVAL_US),
    )


def _peer(host: str, peer_id: str) -> Peer:
    return Peer(_match(_NAME, host), _match(_ID, peer_id))


def _match(pattern: re.Pattern[str], text: str) -> str:
    if not pattern.fullmatch(text):
        raise WireError(f"token part {text[:80]!r}")
    return text


def _number(text: str, top: int) -> int:
    if not _DECIMAL.fullmatch(text) or int(text) > top:
        raise WireError(f"token number {text[:80]!r}")
    return int(text)


def _type_name(chunk: str) -> str:
    # Only the canonical quoting: else one type would have many keys, and so many tokens.
    name = unquote(chunk, errors="replace")
    if not _TYPE_NAME.fullmatch(name) or quote(name, safe="") != chunk:
        raise WireError(f"token type name {chunk[:80]!r}")
    return name
