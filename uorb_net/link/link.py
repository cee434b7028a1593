"""The link: joins a Broker to a Channel, so that remote topics look local.

One thread owns all decisions: it follows the directory, answers what peers say, sends what flows are
due. Channel threads only file news in its inbox; samples alone are written by the thread that
received them. Nothing here runs user code, and no publisher waits for any of it.
"""

from collections import deque
from collections.abc import Callable
from threading import Condition, Thread
from time import monotonic
from typing import Any, ClassVar

import msgspec

from communicator import Advert, Channel, ChannelError, Peer, SampleHeader

from ..broker.broker import Broker
from ..broker.directory import host_name
from ..broker.layout import W_G
from ..broker.waking import Sleeper
from ..clock import hrt_absolute_time
from ..errors import LinkError, UorbError
from . import control
from .events import Events, log
from .hold import Hold
from .incoming import Mirror
from .mirrors import Mirrors
from .outgoing import Offers
from .peers import PeerState
from .status import LinkEvent, LinkStats, PeerStatus, TopicLinkStats

TICK = 0.2  # seconds between heads, and between looks at who died
PING_EVERY = 0.5  # seconds
SURVEY_EVERY = 0.5  # seconds: a dead publisher is unadvertised elsewhere within this and a little
STOP_WAIT = 1.0


class Link:
    """A host's connection of one bus to one channel.

    Args:
        broker: the bus.
        channel: what carries it, such as `communicator.ZenohChannel`.
        host: this host's name for its peers; `$UORB_HOST`, else the system's host name.
    """

    def __init__(self, broker: Broker, channel: Channel, *, host: str | None = None) -> None:
        self.broker = broker
        self.channel = channel
        self.host = host or host_name()
        self.vehicle = broker.vehicle
        self._directory = broker._directory
        self._events = Events(self.host)
        self._inbox: deque[Callable[[], None]] = deque()
        self._changed = Condition()  # guards `_peers`' states, for wait_for_peer
        self._peers: dict[str, PeerState] = {}  # by host: each met once
        self._present: dict[Peer, PeerState] = {}
        self._offers = Offers(self._directory, channel)
        self._mirrors = Mirrors(self._directory, channel, self._events, self._say)
        self._bulletin = -1
        self._malformed = 0
        self._hold: Hold | None = None
        self._thread: Thread | None = None
        self._stopping = False
        self._sleeper = Sleeper()
        channel.register_handler(self)

    # -- life --------------------------------------------------------------------------------------

    def start(self) -> "Link":
        """Join the network; return at once, whether or not anyone is there.

        Raises:
            LinkError: the bus has such a link already, or the channel cannot work as configured.
            ClosedError: the broker is closed.
        """
        if self._thread is not None:
            return self
        self.broker._alive()
        self._hold = Hold(self._directory, type(self.channel).__name__.removesuffix("Channel").lower())
        try:
            self.channel.start(self.vehicle, self.host)
        except ChannelError as error:
            self._hold.release()
            raise LinkError(str(error)) from error
        self._directory.host = self.host
        self._stopping = False
        self._bulletin = -1
        self.broker._users.add(self)
        self._thread = Thread(target=self._run, name=f"uorb-link-{self.host}", daemon=True)
        self._thread.start()
        return self

    def stop(self) -> None:
        """Leave the network within 2 s; mirrored topics are unadvertised. A second call does nothing."""
        thread = self._thread
        if thread is None:
            return
        self._stopping = True
        self._wake()
        thread.join(STOP_WAIT)
        self.channel.stop()
        self._mirrors.drop_all()
        self._offers.nodes.clear()
        self._directory.host = ""
        if self._hold is not None:
            self._hold.release()
        self.broker._users.discard(self)
        self._thread = None

    close = stop

    def spend(self) -> None:
        """In a forked child the link is its parent's."""
        self._thread = None

    def __enter__(self) -> "Link":
        return self.start()

    def __exit__(self, *exc: object) -> None:
        self.stop()

    @property
    def running(self) -> bool:
        """Whether the link is started and its thread lives."""
        return self._thread is not None and self._thread.is_alive()

    # -- what users ask ----------------------------------------------------------------------------

    def wait_for_peer(self, host: str, timeout: float | None = None) -> bool:
        """Block until the peer is up, at most `timeout` seconds; True if it is."""

        def is_up() -> bool:
            state = self._peers.get(host)
            return state is not None and state.state == "up"

        with self._changed:
            return self._changed.wait_for(is_up, timeout)

    def peers(self) -> list[PeerStatus]:
        """Return the state of every host met, by name."""
        return [state.status() for _, state in sorted(self._peers.items())]

    def subscribers(self, topic: str, instance: int = 0) -> list[str]:
        """Return the hosts that subscribe to a topic instance of this host, as far as their wish has arrived."""
        node = self._offers.nodes.get((topic, instance))
        return [] if node is None else sorted(peer.host for peer in list(node.flows))

    def events(self) -> list[LinkEvent]:
        """Return the newest 1,000 events, oldest first."""
        return self._events.list()

    def topic_stats(self) -> list[TopicLinkStats]:
        """Return the totals of every remote topic instance, by origin, topic, instance."""
        stats = [mirror.stats() for mirror in list(self._mirrors.all.values())]
        return sorted(stats, key=lambda s: (s.origin, s.topic, s.instance))

    def stats(self) -> LinkStats:
        """Return the totals since `start`."""
        counters = self.channel.counters()
        mirrors = list(self._mirrors.all.values())
        states = list(self._peers.values())
        return LinkStats(
            host=self.host,
            vehicle=self.vehicle,
            state="down" if self._thread is None else "up" if self._present else "alone",
            peers=sum(state.state in ("up", "degraded") for state in states),
            topics_out=sum(node.advert is not None for node in list(self._offers.nodes.values())),
            topics_in=sum(mirror.node is not None for mirror in mirrors),
            sent_samples=self._offers.sent,
            sent_bytes=counters["sent_bytes"],
            received_samples=sum(state.received for state in states),
            received_bytes=counters["received_bytes"],
            lost=sum(state.lost for state in states),
            retransmitted=self._mirrors.retransmitted + sum(mirror.retransmitted for mirror in mirrors),
            malformed=self._malformed + counters["malformed"],
            mismatched=self._mirrors.mismatched,
            oversized=counters["oversized"],
            thinned=self._mirrors.thinned + sum(mirror.thinned for mirror in mirrors),
        )

    # -- ChannelHandler: called by channel threads -------------------------------------------------

    def process_peer(self, peer: Peer, present: bool) -> None:
        """File a peer's coming or going."""
        self._file(lambda: self._peer(peer, present))

    def process_remote_topic(self, peer: Peer, advert: Advert, advertised: bool) -> None:
        """File an advertisement or its end."""
        self._file(lambda: self._remote_topic(peer, advert, advertised))

    def process_add_subscription(self, peer: Peer, topic: str, instance: int, interval_us: int) -> None:
        """File a peer's wish."""
        self._file(lambda: self._offers.subscribe(peer, topic, instance, interval_us))

    def process_remove_subscription(self, peer: Peer, topic: str, instance: int) -> None:
        """File the end of a peer's wish."""
        self._file(lambda: self._offers.unsubscribe(peer, topic, instance))

    def process_control(self, peer: Peer, body: bytes) -> None:
        """File a control message."""
        now = hrt_absolute_time()
        self._file(lambda: self._control(peer, body, now))

    def process_received_message(
        self, peer: Peer, topic: str, instance: int, header: SampleHeader, payload: bytes
    ) -> None:
        """Write a sample into its mirror, in the thread that received it."""
        mirror = self._mirrors.all.get((peer, topic, instance))
        if mirror is None or mirror.node is None:
            return  # withdrawn here while it was on its way
        mirror.state.heard_us = hrt_absolute_time()
        if not mirror.receive(header, payload, self._ask_gap):
            self._malformed += 1
            text = f"{peer.host} sent {len(payload)} bytes that are no {mirror.advert.type_name} on {topic}"
            self._events.add("malformed", text, peer=peer.host, topic=topic)

    def _ask_gap(self, mirror: Mirror, first: int, last: int) -> None:
        message = control.Gap(mirror.advert.topic, mirror.advert.instance, first, last)
        self._file(lambda: self._say(mirror.peer, message))

    def _file(self, news: Callable[[], None]) -> None:
        self._inbox.append(news)
        self._wake()

    def _wake(self) -> None:
        end = self._sleeper.ends.get(self._directory)
        if end is not None:
            end.poke()

    # -- the link's thread -------------------------------------------------------------------------

    def _run(self) -> None:
        end = self._sleeper.end(self._directory)
        ticked = pinged = surveyed = 0.0
        while not self._stopping:
            try:
                now = monotonic()
                self._read_inbox()
                if self._bulletin != self._directory.bulletin[W_G] or now - surveyed >= SURVEY_EVERY:
                    surveyed = now
                    self._survey()
                if now - ticked >= TICK:
                    ticked = now
                    self._tick(now)
                if now - pinged >= PING_EVERY:
                    pinged = now
                    self._ping()
                self._offers.send_due()
                self.channel.flush()
                self._sleep(end.number)
            except Exception:  # whatever it was, the host's other topics must go on
                log.exception("%s: the link goes on after a fault", self.host)
                self._sleeper.sleep(TICK)

    def _read_inbox(self) -> None:
        for _ in range(len(self._inbox)):
            self._inbox.popleft()()

    def _survey(self) -> None:
        self._bulletin = self._directory.bulletin[W_G]
        self._offers.survey()
        self._mirrors.follow(self._offers.nodes)

    def _sleep(self, number: int) -> None:
        """Arm, look again, sleep until something moves or a held-back sample is due."""
        bulletin = self._directory.bulletin
        self._directory.arm(bulletin, number)
        if not self._offers.arm(number) or self._inbox or self._stopping or self._bulletin != bulletin[W_G]:
            return
        due = self._offers.due_in()
        self._sleeper.sleep(TICK if due is None else max(min(TICK, due), 0.0))

    # -- peers -------------------------------------------------------------------------------------

    def _peer(self, peer: Peer, present: bool) -> None:
        if present:
            state = self._peers.get(peer.host)
            if state is None:
                state = self._peers[peer.host] = PeerState(peer)
            else:
                state.restart(peer)
            self._present[peer] = state
            self._state(state, "connecting")
            self._say(peer, control.Ping(hrt_absolute_time()))
            return
        gone = self._present.pop(peer, None)
        self._mirrors.drop_peer(peer)
        self._offers.drop_peer(peer)
        if gone is not None and gone.peer == peer:
            self._state(gone, "down")

    def _state(self, state: PeerState, name: str) -> None:
        before, since = state.state, state.since_us
        with self._changed:
            changed = state.change(name)
            self._changed.notify_all()
        if changed and name != "connecting":
            seconds = (state.since_us - since) / 1e6
            text = f"{state.peer.host} is {name}, after {seconds:.1f} s {before}"
            self._events.add("peer", text, peer=state.peer.host)

    def _ping(self) -> None:
        now = hrt_absolute_time()
        for peer, state in self._present.items():
            self._say(peer, control.Ping(now))
            silent = (now - state.heard_us) / 1e6
            if state.state == "up" and silent > 2.5 * PING_EVERY:
                self._state(state, "degraded")

    def _say(self, peer: Peer, message: control.Control) -> None:
        self.channel.send_control(peer, control.encode(message))

    def _tick(self, now: float) -> None:
        for mirror in self._mirrors.all.values():
            mirror.look_after(now, self._ask_gap)
        for peer, rows in self._offers.heads(now).items():
            self._say(peer, control.Heads(rows))

    def _remote_topic(self, peer: Peer, advert: Advert, advertised: bool) -> None:
        state = self._present.get(peer)
        if advertised and state is not None:
            self._mirrors.announced(state, advert)
        elif not advertised:
            self._mirrors.drop((peer, advert.topic, advert.instance))

    # -- control messages --------------------------------------------------------------------------

    def _control(self, peer: Peer, body: bytes, now_us: int) -> None:
        state = self._present.get(peer)
        if state is None:
            return
        try:
            message = control.decode(body)
        except msgspec.DecodeError:
            self._malformed += 1
            self._events.add("malformed", f"{peer.host} sent a control message that is none", peer=peer.host)
            return
        state.heard_us = now_us
        if state.state == "degraded":
            self._state(state, "up")
        answer = self._ANSWERS[type(message)]
        answer(self, state, message, now_us)

    def _on_ping(self, state: PeerState, message: control.Ping, now_us: int) -> None:
        self._say(state.peer, control.Pong(message.sent_us, now_us, hrt_absolute_time()))
        if not state.measured:  # our own first ping may have come before the peer had seen us
            self._say(state.peer, control.Ping(hrt_absolute_time()))

    def _on_pong(self, state: PeerState, message: control.Pong, now_us: int) -> None:
        if state.measure(message, now_us) and state.state == "connecting":
            self._state(state, "up")
            self._mirrors.follow(self._offers.nodes)

    def _on_ask(self, state: PeerState, message: control.Ask, now_us: int) -> None:
        node = self._offers.nodes.get((message.topic, message.instance))
        if node is not None and node.label.type_hash == message.type_hash:
            label = node.label
            self._say(state.peer, control.Text(label.type_hash, label.type_name, label.definition))

    def _on_text(self, state: PeerState, message: control.Text, now_us: int) -> None:
        try:
            self._mirrors.learn(message)
        except UorbError as error:
            self._malformed += 1
            text = f"{state.peer.host} sent a definition that cannot be used: {error}"
            self._events.add("malformed", text, peer=state.peer.host)
            return
        self._mirrors.follow(self._offers.nodes)

    def _on_refused(self, state: PeerState, message: control.Refused, now_us: int) -> None:
        self._mirrors.mismatched += 1
        text = f"{state.peer.host} does not take {message.topic}: {message.reason}"
        self._events.add("definition", text, peer=state.peer.host, topic=message.topic)

    def _on_heads(self, state: PeerState, message: control.Heads, now_us: int) -> None:
        for topic, instance, base, sequence in message.heads:
            mirror = self._mirrors.all.get((state.peer, topic, instance))
            if mirror is not None and mirror.demand_us is not None:
                mirror.head(base, sequence)

    def _on_gap(self, state: PeerState, message: control.Gap, now_us: int) -> None:
        self._offers.resend(state.peer, message)

    _ANSWERS: ClassVar[dict[type, Callable[["Link", PeerState, Any, int], None]]] = {
        control.Ping: _on_ping,
        control.Pong: _on_pong,
        control.Ask: _on_ask,
        control.Text: _on_text,
        control.Refused: _on_refused,
        control.Heads: _on_heads,
        control.Gap: _on_gap,
    }
