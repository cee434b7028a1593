"""What a ULog's data sections hold, as frozen records, and how message bodies become values."""

import struct

import msgspec

from uorb_net.logs.formats import PRIMITIVES

Value = int | float | bool | str | bytes
"""What an information message or a parameter holds; arrays other than text stay bytes."""

MSG_ID = struct.Struct("<H")


class Subscription(msgspec.Struct, frozen=True):
    """A series begins: rows with this msg_id are samples of topic and instance.

    ``topic`` is the name of the format too.
    """

    msg_id: int
    topic: str
    instance: int


class Data(msgspec.Struct, frozen=True, gc=False):
    """A row of a series.

    Attributes:
        series: the subscription it belongs to.
        timestamp_us: the row's own timestamp; where the format has none, the latest seen before.
        row: the bytes as ``Layout`` describes them; padding at the end may be missing.
    """

    series: Subscription
    timestamp_us: int
    row: bytes


class Dropout(msgspec.Struct, frozen=True):
    """The logger lost ``duration_ms`` of data; ``timestamp_us`` is the latest row before."""

    timestamp_us: int
    duration_ms: int


class Logged(msgspec.Struct, frozen=True):
    """A text message: ``level`` as in syslog (0 emergency, 7 debug), ``tag`` where it has one."""

    level: int
    timestamp_us: int
    text: str
    tag: int | None = None


class Parameter(msgspec.Struct, frozen=True):
    """A parameter changed; ``timestamp_us`` is the latest row before."""

    timestamp_us: int
    name: str
    value: Value


Record = Subscription | Data | Dropout | Logged | Parameter


def key_value(body: bytes) -> tuple[str, Value]:
    """Return key and value of an ``I`` or ``P`` body, the bytes of the type deciding the value.

    Raises:
        ValueError: the value's length is not its type's.
    """
    kind, key = body[1 : 1 + body[0]].decode("ascii").split(" ", 1)
    raw = body[1 + body[0] :]
    if kind.startswith("char["):
        return key, raw.decode("utf-8", "ignore")
    if kind not in PRIMITIVES:
        return key, raw
    try:
        (value,) = struct.unpack("<" + PRIMITIVES[kind], raw)
    except struct.error:
        raise ValueError(f"{key} has a value of {len(raw)} bytes, {kind} has another size") from None
    return key, value


def logged(body: bytes, *, tagged: bool) -> Logged:
    """Return the text message of an ``L`` body, or of a ``C`` body (tagged)."""
    tag, at = (MSG_ID.unpack_from(body, 1)[0], 3) if tagged else (None, 1)
    (timestamp_us,) = struct.unpack_from("<Q", body, at)
    return Logged(body[0] - ord("0"), timestamp_us, body[at + 8 :].decode("utf-8", "ignore"), tag)
