"""The three ways to verify a copy, forced on any machine, and slots corrupted on purpose."""

import struct
import threading
from collections.abc import Callable
from random import Random
from time import monotonic
from typing import TYPE_CHECKING, Any

import pytest

import uorb_net as uorb
from uorb_net.broker import growth, layout, slots
from uorb_net.broker.layout import MODE_BRACKET, MODE_CRC, MODE_FENCE, PAYLOAD, W_G
from uorb_net.broker.mapping import Mapping
from uorb_net.msg import OrbTest, OrbTestLarge, OrbTestMedium

if TYPE_CHECKING:
    from tests.conftest import Script

MODES = {"bracket": MODE_BRACKET, "crc": MODE_CRC, "fence": MODE_FENCE}


@pytest.fixture(params=MODES)
def mode(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> int:
    """Make this process create its nodes in the mode."""
    mode = MODES[request.param]
    monkeypatch.setattr(layout, "default_mode", lambda length: mode)
    return mode


def slot(mapping: Mapping, number: int) -> int:
    """Return the byte offset of write `number`'s slot."""
    return mapping.offset(number)


def test_the_machine_decides_the_mode(monkeypatch: pytest.MonkeyPatch) -> None:
    """x86-64 needs no more than the bracket; others a checksum up to 256 bytes, and a fence above."""

    class Machine:
        machine = "x86_64"

    monkeypatch.setattr(layout, "uname", Machine)
    assert [layout.default_mode(length) for length in (8, 256, 257, 1 << 20)] == [MODE_BRACKET] * 4
    Machine.machine = "aarch64"
    assert [layout.default_mode(length) for length in (8, 256, 257, 1 << 20)] == [MODE_CRC] * 2 + [MODE_FENCE] * 2


def test_publish_and_copy(broker: uorb.Broker, mode: int) -> None:
    """Queues, overruns and info are the same in each mode."""
    publication = broker.advertise(OrbTestMedium)
    subscription = broker.subscribe(OrbTestMedium)
    assert publication._node.mapping.mode == mode
    for value in range(40):
        publication.publish(OrbTestMedium(val=value, junk=bytes([value]) * 64))
    for value in range(24, 40):
        message, info = subscription.copy_with_info()
        assert (message.val, message.junk, info.generation) == (value, bytes([value]) * 64, value + 1)
    assert subscription.lost == 24
    assert subscription.copy().val == 39


def test_replacement_keeps_the_mode(broker: uorb.Broker, mode: int) -> None:
    """A deeper queue, and samples moved to another file, verify as before."""
    subscription = broker.subscribe(OrbTestLarge)
    publication = broker.advertise(OrbTestLarge, queue_length=30)
    assert publication._node.mapping.mode == mode
    for value in range(30):
        publication.publish(OrbTestLarge(val=value))
    with broker._directory.hold():
        growth.replace(publication._node, 30, 100)
    assert publication._node.mapping.mode == mode
    assert [m.val for m in iter(subscription.update, None)] == list(range(30))


def test_between_processes(shared: uorb.Broker, mode: int, script: Callable[..., "Script"]) -> None:
    """A process that did not create the node follows the mode in its header; nothing is torn."""
    subscription = shared.subscribe(OrbTestLarge)
    script(
        """
pub = uorb.Broker().advertise("orb_test_large")
k = 0
while True:
    k += 1
    pub.publish(msg.OrbTestLarge(val=k, junk=bytes([k % 256]) * 512))
"""
    )
    seen = 0
    assert subscription.wait(20.0)
    until = monotonic() + 20.0
    while seen < 2000 and monotonic() < until:
        message = subscription.update()
        if message is not None:
            seen += 1
            assert message.junk == bytes([message.val % 256]) * 512
    assert seen == 2000


def test_overtaken_while_reading(broker: uorb.Broker, mode: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """A reader that is overtaken while it decodes starts again, from the oldest whole sample, and counts the rest."""
    publication = broker.advertise(OrbTestMedium, queue_length=4)
    subscription = broker.subscribe(OrbTestMedium)
    for value in range(4):
        publication.publish(OrbTestMedium(val=value))
    decode = subscription._decode
    total = publication._node.mapping.slots

    def overtaken(buffer: Any, offset: int) -> Any:
        monkeypatch.setattr(subscription, "_decode", decode)
        for value in range(4, 4 + total):
            publication.publish(OrbTestMedium(val=value))
        return decode(buffer, offset)

    monkeypatch.setattr(subscription, "_decode", overtaken)
    assert subscription.copy().val == total
    assert subscription.lost == total
    assert [m.val for m in iter(subscription.update, None)] == [total + 1, total + 2, total + 3]


def test_overtaken_by_one_slot(broker: uorb.Broker, mode: int) -> None:
    """The slot that the next write goes to is refused before it begins; the one after it once G has moved."""
    publication = broker.advertise(OrbTest)
    for value in range(10):
        publication.publish(OrbTest(val=value))
    mapping = publication._node.mapping
    oldest = 10 - mapping.slots + 1
    assert slots.read(mapping, oldest - 1) is None
    assert slots.read(mapping, oldest) is not None
    mapping.words[W_G] += 1  # as the next write ends
    assert slots.read(mapping, oldest) is None
    assert slots.read(mapping, oldest + 1) is not None
    assert slots.read(mapping, 10) is None  # its slot holds another number


@pytest.mark.parametrize("what", ["garbage", "number", "zeros"])
@pytest.mark.parametrize("depth", [1, 4])
def test_a_corrupt_slot_is_never_delivered(
    broker: uorb.Broker, mode: int, what: str, depth: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A slot overwritten by something else is DecodeError, in bounded time, and lost; the others are delivered."""
    monkeypatch.setattr(slots, "PATIENCE", 0.02)
    publication = broker.advertise(OrbTest, queue_length=depth)
    plain, informed = broker.subscribe(OrbTest), broker.subscribe(OrbTest)
    for value in range(depth):
        publication.publish(OrbTest(val=value))
    mapping = publication._node.mapping
    bad = depth - 1
    at = slot(mapping, bad)
    if what == "number":
        mapping.words[at >> 3] = 12345
    else:
        fill = b"\xa5" if what == "garbage" else b"\0"
        mapping.buffer[at : at + mapping.stride] = fill * mapping.stride
    started = monotonic()
    for reader in (plain, informed):
        for value in range(bad):
            assert reader.copy().val == value
        with pytest.raises(uorb.DecodeError, match="damaged"):
            reader.copy() if reader is plain else reader.copy_with_info()
        assert reader.lost == 1
        assert not reader.check()
        assert reader.generation == depth
        with pytest.raises(uorb.DecodeError):  # the newest again
            reader.copy()
        assert reader.lost == 1
    assert plain.stat() == 0
    assert broker.topics()[0].generation == depth
    assert monotonic() - started < 3.0
    publication.publish(OrbTest(val=77))
    assert plain.copy().val == informed.copy_with_info().message.val == 77
    assert broker.topics()[0].lost == 2


def test_every_flipped_byte_is_found_by_the_checksum(broker: uorb.Broker, monkeypatch: pytest.MonkeyPatch) -> None:
    """In crc mode no byte of header, payload or checksum can change unseen."""
    monkeypatch.setattr(layout, "default_mode", lambda length: MODE_CRC)
    publication = broker.advertise(OrbTest, OrbTest(val=1))
    mapping = publication._node.mapping
    at = slot(mapping, 0)
    assert slots.read(mapping, 0) is not None
    for offset in range(at, at + PAYLOAD + mapping.length + 4):
        for bit in (1, 128):
            mapping.buffer[offset] ^= bit
            assert slots.read(mapping, 0) is None, f"byte {offset - at}"
            mapping.buffer[offset] ^= bit
    assert slots.read(mapping, 0) is not None


def test_a_checksum_that_comes_late_is_waited_for(
    broker: uorb.Broker, monkeypatch: pytest.MonkeyPatch, in_thread: Callable[..., Any]
) -> None:
    """A payload that becomes visible a little after G, as weakly ordered processors may show it, is delivered."""
    monkeypatch.setattr(layout, "default_mode", lambda length: MODE_CRC)
    publication = broker.advertise(OrbTest)
    subscription = broker.subscribe(OrbTest)
    mapping = publication._node.mapping
    publication.publish(OrbTest(val=5))
    at = slot(mapping, 0) + PAYLOAD + 12
    value = bytes(mapping.buffer[at : at + 4])
    assert struct.unpack("<i", value) == (5,)
    mapping.buffer[at : at + 4] = bytes(4)

    def settle() -> None:
        mapping.buffer[at : at + 4] = value

    timer = threading.Timer(0.03, settle)
    timer.start()
    assert subscription.copy().val == 5
    timer.join()


def test_random_damage_never_hangs(broker: uorb.Broker, mode: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever bytes the slots hold, reading ends: a message, DecodeError or None."""
    monkeypatch.setattr(slots, "PATIENCE", 0.002)
    draw = Random(7)
    publication = broker.advertise(OrbTestMedium)
    subscription = broker.subscribe(OrbTestMedium)
    for value in range(60):
        publication.publish(OrbTestMedium(val=value))
        mapping = publication._node.mapping
        at = mapping.base + draw.randrange(mapping.slots * mapping.stride - 9)
        mapping.buffer[at : at + 8] = draw.randbytes(8)
        for call in (subscription.update, subscription.stat, subscription.copy_with_info, broker.topics):
            try:
                call()
            except uorb.DecodeError:
                continue


def test_no_generation_is_read_from_a_word_that_straddles() -> None:
    """Every word the protocol rests on is 8 bytes, aligned: G, hint, shared, busy and each slot's number."""
    for index in (layout.W_G, layout.W_HINT, layout.W_SHARED):
        assert index * 8 % 64 == 0  # on cache lines of their own
    assert len({layout.W_G // 8, layout.W_HINT // 8, layout.W_SHARED // 8}) == 3
    label = layout.Label("a_topic", 0, "AType", "RIHS01_0", "uint64 timestamp")
    for length in (1, 12, 76, 513, 5000):
        for mode in MODES.values():
            for depth in (1, 2, 3, 5, 16, 255):
                shape = layout.pick(label, length, depth, 0, mode)
                assert shape.stride % 64 == shape.base % layout.PAGE == 0
                assert shape.slots >= depth + 2
                assert shape.stride >= PAYLOAD + length + (4 if mode == MODE_CRC else 0)
                assert shape.size >= shape.base + shape.slots * shape.stride
