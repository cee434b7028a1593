"""The picture of the peers is right whatever order tokens come in, and each handler call is in its place."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from communicator import Advert, ChannelError, Peer
from communicator.recorder import Recorder
from communicator.state import Directory, LocalTopics, News, PeerNews, SubscriptionNews, TopicNews
from communicator.tokens import MAX_STREAM, AdvertToken, HostToken, SubscriptionToken, Token
from communicator.wire import WireError

OWN = "00000000000000aa"
A = Peer("a", "00000000000000a1")
B = Peer("b", "00000000000000b1")


def advert(topic: str, queue_length: int = 1) -> Advert:
    """An advert of instance 0."""
    return Advert(topic, 0, "T", "h", 8, queue_length, 50, True)


def subscription(peer: Peer, stream: int, interval_us: int) -> SubscriptionToken:
    """A subscription to one of the two topics of `directory`."""
    return SubscriptionToken(OWN, peer, stream, ("own0", "own1")[stream], 0, interval_us)


def directory() -> Directory:
    """A directory of a link that announced own0 and own1."""
    local = LocalTopics()
    assert [local.announce(advert(name)) for name in ("own0", "own1")] == [0, 1]
    return Directory(OWN, local)


TOKENS: list[Token] = [
    token
    for peer in (A, B)
    for token in (
        HostToken(peer),
        AdvertToken(peer, 0, advert("x")),
        AdvertToken(peer, 1, advert("y")),
        AdvertToken(peer, 1, advert("y", queue_length=4)),
        subscription(peer, 0, 1000),
        subscription(peer, 0, 0),
        subscription(peer, 1, 500),
    )
]


class Picture:
    """What a handler knows that believes every call; a call out of place fails."""

    def __init__(self) -> None:
        self.adverts: dict[Peer, dict[str, Advert]] = {}
        self.intervals: dict[Peer, dict[str, int]] = {}

    def take(self, news: News) -> None:
        """Believe one piece of news."""
        match news:
            case PeerNews(peer, True):
                assert peer not in self.adverts
                self.adverts[peer], self.intervals[peer] = {}, {}
            case PeerNews(peer, False):
                del self.adverts[peer], self.intervals[peer]
            case TopicNews(peer, shown, True):
                assert self.adverts[peer].get(shown.topic) != shown
                self.adverts[peer][shown.topic] = shown
            case TopicNews(peer, shown, False):
                assert self.adverts[peer].pop(shown.topic) == shown
            case SubscriptionNews(peer, (topic, _), None):
                del self.intervals[peer][topic]
            case SubscriptionNews(peer, (topic, _), int() as interval):
                assert self.intervals[peer].get(topic) != interval
                self.intervals[peer][topic] = interval


@given(st.lists(st.tuples(st.sampled_from(TOKENS), st.booleans()), max_size=60))
def test_the_picture_follows_the_set_of_tokens(changes: list[tuple[Token, bool]]) -> None:
    seen, picture, tokens = directory(), Picture(), set[Token]()
    for token, present in changes:
        (tokens.add if present else tokens.discard)(token)
        for news in seen.apply(token, present):
            picture.take(news)
        present_peers = {peer for peer in (A, B) if HostToken(peer) in tokens}
        assert set(picture.adverts) == present_peers
        for peer in present_peers:
            wanted: dict[str, int] = {}
            shown = {t.advert for t in tokens if isinstance(t, AdvertToken) and t.peer == peer}
            for t in tokens:
                if isinstance(t, SubscriptionToken) and t.peer == peer:
                    wanted[t.topic] = min(t.interval_us, wanted.get(t.topic, t.interval_us))
            assert picture.intervals[peer] == wanted
            assert set(picture.adverts[peer]) == {a.topic for a in shown}
            assert set(picture.adverts[peer].values()) <= shown


@given(st.permutations([t for t in TOKENS if t.peer == A and t != TOKENS[3]]))
def test_any_order_of_arrival_ends_in_one_picture(order: list[Token]) -> None:
    seen, picture = directory(), Picture()
    for token in order:
        for news in seen.apply(token, True):
            picture.take(news)
    assert picture.adverts == {A: {"x": advert("x"), "y": advert("y")}}
    assert picture.intervals == {A: {"own0": 0, "own1": 500}}


def test_a_peer_that_comes_back_is_announced_with_all_it_has() -> None:
    seen = directory()
    for token in (AdvertToken(A, 0, advert("x")), subscription(A, 1, 7), HostToken(A)):
        seen.apply(token, True)
    assert seen.apply(HostToken(A), False) == [PeerNews(A, False)]
    assert seen.apply(HostToken(A), True) == [
        PeerNews(A, True),
        TopicNews(A, advert("x"), True),
        SubscriptionNews(A, ("own1", 0), 7),
    ]


def test_a_rate_changes_without_a_moment_of_none() -> None:
    seen = directory()
    seen.apply(HostToken(A), True)
    news = seen.apply(subscription(A, 0, 1000), True)
    news += seen.apply(subscription(A, 0, 5000), True)  # slower: the old one still counts
    news += seen.apply(subscription(A, 0, 1000), False)
    news += seen.apply(subscription(A, 0, 0), True)
    news += seen.apply(subscription(A, 0, 5000), False)
    assert news == [SubscriptionNews(A, ("own0", 0), i) for i in (1000, 5000, 0)]
    assert seen.apply(subscription(A, 0, 0), False) == [SubscriptionNews(A, ("own0", 0), None)]


def test_a_replaced_advert_is_one_piece_of_news() -> None:
    seen = directory()
    seen.apply(HostToken(A), True)
    seen.apply(AdvertToken(A, 0, advert("x")), True)
    deeper = advert("x", queue_length=8)
    assert seen.apply(AdvertToken(A, 0, deeper), True) == [TopicNews(A, deeper, True)]
    assert seen.apply(AdvertToken(A, 0, advert("x")), False) == []
    assert seen.apply(AdvertToken(A, 0, deeper), False) == [TopicNews(A, deeper, False)]


def test_stream_names_outlive_the_advert_but_not_the_peer() -> None:
    seen = directory()
    source_id = bytes.fromhex(A.instance_id)
    seen.apply(AdvertToken(A, 3, advert("x")), True)
    assert seen.source(source_id) is None
    seen.apply(HostToken(A), True)
    seen.apply(AdvertToken(A, 3, advert("x")), False)
    source = seen.source(source_id)
    assert source is not None
    assert (source.peer, source.topics) == (A, {3: ("x", 0)})
    assert seen.stream(A, ("x", 0)) == 3
    seen.apply(HostToken(A), False)
    assert seen.source(source_id) is None
    assert seen.stream(A, ("x", 0)) is None


@pytest.mark.parametrize(
    "token",
    [
        AdvertToken(A, 0, advert("other")),
        AdvertToken(A, 9, advert("x")),
        HostToken(Peer("impostor", A.instance_id)),
        SubscriptionToken(OWN, A, 0, "own1", 0, 0),
        SubscriptionToken(OWN, A, 9, "own9", 0, 0),
        SubscriptionToken(B.instance_id, A, 0, "own0", 0, 0),
    ],
)
def test_contradictions_are_refused_once_and_change_nothing(token: Token) -> None:
    seen = directory()
    seen.apply(HostToken(A), True)
    seen.apply(AdvertToken(A, 0, advert("x")), True)
    with pytest.raises(WireError):
        seen.apply(token, True)
    assert seen.apply(token, False) == []
    assert seen.apply(HostToken(A), False) == [PeerNews(A, False)]
    assert seen.apply(HostToken(A), True) == [PeerNews(A, True), TopicNews(A, advert("x"), True)]


def test_own_tokens_and_other_versions_are_no_news() -> None:
    seen = directory()
    own = Peer("me", OWN)
    assert seen.apply(HostToken(own), True) == []
    assert seen.apply(AdvertToken(own, 0, advert("own0")), True) == []
    assert seen.apply(HostToken(A, version=2), True) == []
    assert seen.apply(HostToken(A), True) == [PeerNews(A, True)]


def test_news_is_told_in_the_handler_verbs() -> None:
    handler = Recorder()
    for news in (
        PeerNews(A, True),
        TopicNews(A, advert("x"), True),
        SubscriptionNews(A, ("own0", 0), 5),
        SubscriptionNews(A, ("own0", 0), None),
    ):
        news.deliver(handler)
    assert handler.events == [
        ("peer", A, True),
        ("remote_topic", A, advert("x"), True),
        ("add_subscription", A, "own0", 0, 5),
        ("remove_subscription", A, "own0", 0),
    ]


def test_stream_numbers_stay_and_run_out_loudly() -> None:
    local = LocalTopics()
    for number in range(MAX_STREAM + 1):
        assert local.announce(advert(f"t{number}")) == number
    assert local.announce(advert("t5", queue_length=3)) == 5
    assert local.topic(5) == ("t5", 0)
    assert local.topic(MAX_STREAM + 1) is None
    with pytest.raises(ChannelError, match="65536"):
        local.announce(advert("one_more"))
