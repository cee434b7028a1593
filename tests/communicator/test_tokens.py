"""Token keys say what they were made from, each token has one key, and no other key is a token."""

from typing import get_args

import pytest
from hypothesis import given
from hypothesis import strategies as st

from communicator import Advert, ChannelError, Peer
from communicator.tokens import (
    AdvertToken,
    HostToken,
    SubscriptionToken,
    Token,
    check_advert,
    check_name,
    format_token,
    parse_token,
)
from communicator.wire import WireError

NAMES = st.from_regex(r"[A-Za-z0-9_.-]{1,64}", fullmatch=True)
IDS = st.from_regex(r"[0-9a-f]{16}", fullmatch=True)
PEERS = st.builds(Peer, NAMES, IDS)
U32 = st.integers(0, 2**32 - 1)
U16 = st.integers(0, 2**16 - 1)
U8 = st.integers(0, 255)
ADVERTS = st.builds(
    Advert,
    topic=NAMES,
    instance=U8,
    type_name=st.from_regex(r"[!-~]{1,80}", fullmatch=True),
    type_hash=NAMES,
    payload_length=U32,
    queue_length=U16,
    priority=U8,
    shared=st.booleans(),
)
TOKENS: st.SearchStrategy[Token] = st.one_of(
    st.builds(HostToken, PEERS, U16),
    st.builds(AdvertToken, PEERS, U16, ADVERTS),
    st.builds(SubscriptionToken, IDS, PEERS, U16, NAMES, U8, U32),
)
ADVERT = Advert("imu", 0, "px4_msgs/msg/Imu", "RIHS01_" + "0" * 64, 52, 1, 50, True)
PEER = Peer("autopilot", "0123456789abcdef")


def accepted(key: str) -> Token | None:
    """Return what the parser makes of a key; anything but WireError fails the test."""
    try:
        return parse_token("uav1", key)
    except WireError:
        return None


@given(TOKENS)
def test_a_key_gives_back_its_token(token: Token) -> None:
    assert parse_token("uav1", format_token("uav1", token)) == token


@given(TOKENS, st.data())
def test_whatever_key_is_taken_is_the_only_one_of_its_token(token: Token, data: st.DataObject) -> None:
    key = format_token("uav1", token)
    at = data.draw(st.integers(0, len(key) - 1))
    size = data.draw(st.integers(0, 3))
    changed = key[:at] + data.draw(st.text(max_size=3)) + key[at + size :]
    found = accepted(changed)
    assert found is None or format_token("uav1", found) == changed


@given(st.text(max_size=100))
def test_garbage_is_refused(key: str) -> None:
    assert accepted(key) is None
    for kind in ("@host", "@adv", "@sub"):
        found = accepted(f"uorb/uav1/{kind}/{key}")
        assert found is None or isinstance(found, get_args(Token))


@pytest.mark.parametrize(
    "key",
    [
        "uorb/uav2/@host/a/0123456789abcdef/1",
        "other/uav1/@host/a/0123456789abcdef/1",
        "uorb/uav1/@host/a/0123456789abcdef",
        "uorb/uav1/@host/a/0123456789abcdef/1/2",
        "uorb/uav1/@host/a/0123456789abcdef/01",
        "uorb/uav1/@host/a/0123456789abcdef/+1",
        "uorb/uav1/@host/a/0123456789abcdef/\u0661",
        "uorb/uav1/@host/a/0123456789ABCDEF/1",
        "uorb/uav1/@host/a b/0123456789abcdef/1",
        "uorb/uav1/@host/a/0123456789abcdef/65536",
        "uorb/uav1/@nest/a/0123456789abcdef/1",
        "uorb/uav1/@sub/x/a/0123456789abcdef/0/imu/0/0",
        "uorb/uav1/@sub/0123456789abcdef/a/0123456789abcdef/0/imu/256/0",
        "uorb/uav1/@sub/0123456789abcdef/a/0123456789abcdef/0/imu/0/4294967296",
        "uorb/uav1/@adv/a/0123456789abcdef/0/imu/0/T/h/52/1/50/x",
        "uorb/uav1/@adv/a/0123456789abcdef/0/imu/0/%54/h/52/1/50/s",
        "uorb/uav1/@adv/a/0123456789abcdef/0/imu/0/T/h/52/1/300/s",
        "uorb/uav1/@host/" + "a" * 2000 + "/0123456789abcdef/1",
    ],
)
def test_wrong_keys_are_refused(key: str) -> None:
    assert accepted(key) is None


def test_type_names_with_slashes_travel_quoted() -> None:
    key = format_token("uav1", AdvertToken(PEER, 7, ADVERT))
    assert key == (
        f"uorb/uav1/@adv/autopilot/0123456789abcdef/7/imu/0/px4_msgs%2Fmsg%2FImu/RIHS01_{'0' * 64}/52/1/50/s"
    )


@pytest.mark.parametrize("name", ["", "a/b", "*", "@x", "a b", "x" * 65, "naïve", "a$", "a\n"])
def test_names_that_cannot_stand_in_a_key_are_misuse(name: str) -> None:
    with pytest.raises(ChannelError, match="topic"):
        check_name("topic", name)


@pytest.mark.parametrize(
    "advert",
    [
        Advert("a/b", 0, "T", "h", 1, 1, 1, True),
        Advert("a", 256, "T", "h", 1, 1, 1, True),
        Advert("a", -1, "T", "h", 1, 1, 1, True),
        Advert("a", 0, "", "h", 1, 1, 1, True),
        Advert("a", 0, "a type", "h", 1, 1, 1, True),
        Advert("a", 0, "T", "h/h", 1, 1, 1, True),
        Advert("a", 0, "T", "h", 2**32, 1, 1, True),
        Advert("a", 0, "T", "h", 1, 2**16, 1, True),
        Advert("a", 0, "T", "h", 1, 1, 256, True),
    ],
)
def test_adverts_that_cannot_travel_are_misuse(advert: Advert) -> None:
    with pytest.raises(ChannelError):
        check_advert(advert)
