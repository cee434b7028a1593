"""What two links say to each other beside samples: MessagePack arrays with a tag, any of them may be lost.

docs/wire.md lists them with their meaning; whoever needs an answer asks again.
"""

import msgspec


class Ping(msgspec.Struct, frozen=True, array_like=True, tag="ping"):
    """Asks for a `Pong`; the time is the sender's, microseconds."""

    sent_us: int


class Pong(msgspec.Struct, frozen=True, array_like=True, tag="pong"):
    """Answers a `Ping`: its time, and when it came and this left by the answering host's clock."""

    ping_us: int
    received_us: int
    sent_us: int


class Ask(msgspec.Struct, frozen=True, array_like=True, tag="ask"):
    """Asks for the definition text of a topic instance of the receiver's."""

    topic: str
    instance: int
    type_hash: str


class Text(msgspec.Struct, frozen=True, array_like=True, tag="text"):
    """Answers an `Ask`: the self-contained definition text."""

    type_hash: str
    type_name: str
    definition: str


class Refused(msgspec.Struct, frozen=True, array_like=True, tag="refused"):
    """Tells a publisher that its topic is not taken here, and why."""

    topic: str
    instance: int
    reason: str


class Heads(msgspec.Struct, frozen=True, array_like=True, tag="heads"):
    """Repeats what the receiver's flows owe it: topic, instance, the number before the first, the newest sent."""

    heads: list[tuple[str, int, int, int]]


class Gap(msgspec.Struct, frozen=True, array_like=True, tag="gap"):
    """Asks for the publications `first` to `last` of a topic instance of the receiver's once more."""

    topic: str
    instance: int
    first: int
    last: int


Control = Ping | Pong | Ask | Text | Refused | Heads | Gap

encode = msgspec.msgpack.Encoder().encode
decode = msgspec.msgpack.Decoder(Control).decode
