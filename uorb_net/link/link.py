"""The link: joins a Broker to a Channel, so that remote topics look local.

One thread owns all decisions: it follows the directory, answers what peers say, sends what flows are
due. Channel threads only file news in its inbox; samples alone are written by the thread that
received them. Nothing here runs user code, and no publisher waits for any of it.
"""

from collections import deque
from collections.abc import Callable
from threading import Condition, Thread
from time import monotonic
from typing import TYPE_CHECKING, Any, ClassVar

import msgspec

from communicator import Advert, Channel, ChannelError, Peer, SampleHeader

from ..broker import members
from ..broker.broker import Broker
from ..broker.directory import host_name
from ..broker.layout import GENERATION, W_G, W_LAPSED
from ..broker.waking import Sleeper
from ..clock import hrt_absolute_time
from ..errors import BusError, ClosedError, InstanceError, LinkError, TopicMismatchError, UorbError
from . import control
from .events import Events, log
from .hold import Hold
from .incoming import Mirror
from .outgoing import LocalNode
from .peers import PeerState
from .status import LinkEvent, LinkStats, PeerStatus, TopicLinkStats

if TYPE_CHECKING:
    from ..messages import Message

TICK = 0.2  # seconds between heads, and between looks at who died
PING_EVERY = 0.5  # seconds
ASK_EVERY = 0.5  # seconds between two requests for a definition
SURVEY_EVERY = 0.5  # seconds: a dead publisher is unadvertised elsewhere within this and a little
STOP_WAIT = 1.0

Key = tuple[Peer, str, int]


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
        self._mirrors: dict[Key, Mirror] = {}
        self._nodes: dict[tuple[str, int], LocalNode] = {}
        self._types: dict[str, type[Message]] = {}  # by hash: definitions that peers sent
        self._asked: dict[str, float] = {}  # by hash: when a definition was asked for last
        self._bulletin = -1
        self._sent = self._malformed = self._mismatched = self._retransmitted = 0
        self._lost_before = self._received_before = self._thinned_before = 0  # of mirrors that are gone
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
        for mirror in list(self._mirrors.values()):
            self._withdraw(mirror)
        self._mirrors.clear()
        self._nodes.clear()
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

    def events(self) -> list[LinkEvent]:
        """Return the newest 1,000 events, oldest first."""
        return self._events.list()

    def topic_stats(self) -> list[TopicLinkStats]:
        """Return the totals of every remote topic instance, by origin, topic, instance."""
        stats = [mirror.stats() for mirror in list(self._mirrors.values())]
        return sorted(stats, key=lambda s: (s.origin, s.topic, s.instance))

    def stats(self) -> LinkStats:
        """Return the totals since `start`."""
        counters = self.channel.counters()
        mirrors = list(self._mirrors.values())
        states = list(self._peers.values())
        return LinkStats(
            host=self.host,
            vehicle=self.vehicle,
            state="down" if self._thread is None else "up" if self._present else "alone",
            peers=sum(state.state in ("up", "degraded") for state in states),
            topics_out=sum(node.advert is not None for node in list(self._nodes.values())),
            topics_in=sum(mirror.node is not None for mirror in mirrors),
            sent_samples=self._sent,
            sent_bytes=counters["sent_bytes"],
            received_samples=sum(state.received for state in states),
            received_bytes=counters["received_bytes"],
            lost=sum(state.lost for state in states),
            retransmitted=self._retransmitted + sum(mirror.retransmitted for mirror in mirrors),
            malformed=self._malformed + counters["malformed"],
            mismatched=self._mismatched,
            oversized=counters["oversized"],
            thinned=self._thinned_before + sum(mirror.thinned for mirror in mirrors),
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
        self._file(lambda: self._add_subscription(peer, topic, instance, interval_us))

    def process_remove_subscription(self, peer: Peer, topic: str, instance: int) -> None:
        """File the end of a peer's wish."""
        self._file(lambda: self._remove_subscription(peer, topic, instance))

    def process_control(self, peer: Peer, body: bytes) -> None:
        """File a control message."""
        now = hrt_absolute_time()
        self._file(lambda: self._control(peer, body, now))

    def process_received_message(
        self, peer: Peer, topic: str, instance: int, header: SampleHeader, payload: bytes
    ) -> None:
        """Write a sample into its mirror, in the thread that received it."""
        mirror = self._mirrors.get((peer, topic, instance))
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
                self._send_due()
                self.channel.flush()
                self._sleep(end.number, TICK)
            except (UorbError, OSError):
                log.exception("%s: link goes on after an error", self.host)
                self._sleeper.sleep(TICK)
            except Exception:
                log.exception("%s: link goes on after a fault of its own", self.host)
                self._sleeper.sleep(TICK)

    def _read_inbox(self) -> None:
        for _ in range(len(self._inbox)):
            self._inbox.popleft()()

    def _sleep(self, number: int, seconds: float) -> None:
        """Arm, look again, sleep until something moves or a held-back sample is due."""
        directory = self._directory
        directory.arm(directory.bulletin, number)
        flowing = [node for node in self._nodes.values() if node.flows]
        for node in flowing:
            directory.arm(node.mapping.words, number)
        if self._inbox or self._stopping or self._bulletin != directory.bulletin[W_G]:
            return
        due = []
        for node in flowing:
            if node.mapping.words[W_G] != node.seen:
                return
            when = node.next_due_us()
            if when is not None:
                due.append((when - hrt_absolute_time()) / 1e6)
        self._sleeper.sleep(max(min([seconds, *due]), 0.0))

    def _send_due(self) -> None:
        now_us = hrt_absolute_time()
        for node in self._nodes.values():
            if node.flows:
                self._sent += node.send_due(self.channel, now_us)

    # -- this host's nodes -------------------------------------------------------------------------

    def _survey(self) -> None:
        """Follow the directory: announce, take back, ask, stop asking."""
        self._bulletin = self._directory.bulletin[W_G]
        names = set(self._directory.names())
        for key in [key for key in self._nodes if key not in names]:
            self._forget_node(key)
        for key in names:
            node = self._nodes.get(key)
            if node is None or node.moved:
                node = self._open_node(key, node)
            if node is not None:
                self._follow_node(key, node)
        self._follow_demand()

    def _open_node(self, key: tuple[str, int], old: LocalNode | None) -> LocalNode | None:
        mapping = self._directory.find(*key, populate=False)
        if mapping is None:
            return None
        node = LocalNode(mapping)
        if old is not None and old.label.type_hash == node.label.type_hash:
            node.continue_from(old)
        elif old is not None:
            self._forget_node(key)
        self._nodes[key] = node
        return node

    def _follow_node(self, key: tuple[str, int], node: LocalNode) -> None:
        node.look(self._directory)
        advert = node.offer(self._directory)
        if advert != node.advert:
            if advert is not None:
                self.channel.topic_advertised(advert)
            else:
                self.channel.topic_unadvertised(*key)
            node.advert = advert

    def _forget_node(self, key: tuple[str, int]) -> None:
        node = self._nodes.pop(key)
        if node.advert is not None:
            self.channel.topic_unadvertised(*key)

    def _follow_demand(self) -> None:
        """Ask each peer for what somebody here subscribes to, at the fastest rate wanted."""
        for mirror in list(self._mirrors.values()):
            if mirror.node is None:
                self._install(mirror)
                continue
            label = mirror.node.label
            local = self._nodes.get((label.topic, label.instance))
            if local is None or local.label.type_hash != mirror.advert.type_hash:
                self._yield_to_local(mirror)
            else:
                self._demand(mirror, local.interval_us if local.subscribers else None)

    def _demand(self, mirror: Mirror, interval_us: int | None) -> None:
        if interval_us == mirror.demand_us:
            return
        where = (mirror.peer, mirror.advert.topic, mirror.advert.instance)
        if interval_us is None:
            mirror.end()
            self.channel.remove_subscription(*where)
            assert mirror.node is not None
            words = mirror.node.mapping.words
            words[W_LAPSED] = words[W_G] & GENERATION
        else:
            if mirror.demand_us is None:
                mirror.begin(interval_us)
            mirror.demand_us = interval_us
            self.channel.add_subscription(*where, interval_us)

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
        for key in [key for key in self._mirrors if key[0] == peer]:
            self._drop_mirror(key)
        for node in self._nodes.values():
            node.flows.pop(peer, None)
        if gone is not None and gone.peer == peer:
            self._state(gone, "down")

    def _state(self, state: PeerState, name: str) -> None:
        before, since = state.state, state.since_us
        with self._changed:
            changed = state.change(name)
            self._changed.notify_all()
        if changed and name != "connecting":
            seconds = (state.since_us - since) / 1e6
            text = f"peer {state.peer.host} is {name}, after {seconds:.1f} s {before}"
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
        for mirror in self._mirrors.values():
            mirror.give_up(now)
        heads: dict[Peer, list[tuple[str, int, int]]] = {}
        for node in self._nodes.values():
            for flow in node.changed_flows(now):
                heads.setdefault(flow.peer, []).append((node.label.topic, node.label.instance, flow.sequence))
        for peer, rows in heads.items():
            self._say(peer, control.Heads(rows))

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

    def _on_pong(self, state: PeerState, message: control.Pong, now_us: int) -> None:
        if state.measure(message, now_us) and state.state == "connecting":
            self._state(state, "up")

    def _on_ask(self, state: PeerState, message: control.Ask, now_us: int) -> None:
        node = self._nodes.get((message.topic, message.instance))
        if node is not None and node.label.type_hash == message.type_hash:
            label = node.label
            self._say(state.peer, control.Text(label.type_hash, label.type_name, label.definition))

    def _on_text(self, state: PeerState, message: control.Text, now_us: int) -> None:
        from .. import messages

        if message.type_hash not in self._asked:
            return
        try:
            cls = messages.from_text(message.type_name, message.definition)
        except UorbError as error:
            self._bad_definition(state, f"sent a definition that cannot be used: {error}")
            return
        if cls.__uorb__.type_hash != message.type_hash:
            self._bad_definition(
                state, f"sent a definition of {message.type_name} that is not what it announced"
            )
            return
        self._types[message.type_hash] = cls
        self._follow_demand()

    def _bad_definition(self, state: PeerState, text: str) -> None:
        self._malformed += 1
        self._events.add("malformed", f"{state.peer.host} {text}", peer=state.peer.host)

    def _on_refused(self, state: PeerState, message: control.Refused, now_us: int) -> None:
        self._mismatched += 1
        text = f"{state.peer.host} does not take {message.topic}: {message.reason}"
        self._events.add("definition", text, peer=state.peer.host, topic=message.topic)

    def _on_heads(self, state: PeerState, message: control.Heads, now_us: int) -> None:
        for topic, instance, sequence in message.heads:
            mirror = self._mirrors.get((state.peer, topic, instance))
            if mirror is not None and mirror.demand_us is not None:
                mirror.head(sequence, self._ask_gap)

    def _on_gap(self, state: PeerState, message: control.Gap, now_us: int) -> None:
        node = self._nodes.get((message.topic, message.instance))
        if node is not None:
            self._sent += node.resend(state.peer, message.first, message.last, self.channel)

    _ANSWERS: ClassVar[dict[type, Callable[["Link", PeerState, Any, int], None]]] = {
        control.Ping: _on_ping,
        control.Pong: _on_pong,
        control.Ask: _on_ask,
        control.Text: _on_text,
        control.Refused: _on_refused,
        control.Heads: _on_heads,
        control.Gap: _on_gap,
    }

    # -- what peers offer and want -----------------------------------------------------------------

    def _remote_topic(self, peer: Peer, advert: Advert, advertised: bool) -> None:
        state = self._present.get(peer)
        key = (peer, advert.topic, advert.instance)
        known = self._mirrors.get(key)
        if known is not None and (not advertised or advert != known.advert):
            self._drop_mirror(key)
            known = None
        if advertised and state is not None and known is None:
            mirror = self._mirrors[key] = Mirror(state, advert)
            self._install(mirror)

    def _install(self, mirror: Mirror) -> None:
        """Give a mirror its node on this bus, as soon as its definition is known and nothing forbids it."""
        cls = self._type_of(mirror)
        if cls is None:
            return
        advert = mirror.advert
        try:
            with self._directory.hold():
                instance = self._place(advert)
                node = members.advertise(
                    self._directory,
                    cls.__uorb__,
                    advert.topic,
                    instance,
                    priority=advert.priority,
                    queue_length=advert.queue_length,
                    host=mirror.peer.host,
                    own=not advert.shared,
                )
                mirror.origin = node.mapping.origin_index(mirror.peer.host)
        except TopicMismatchError as error:
            self._refuse(mirror, str(error))
        except InstanceError as error:
            self._once(mirror, "instance", f"{mirror.name} of {mirror.peer.host} is ignored: {error}")
        except BusError as error:
            self._once(mirror, "config", f"{mirror.name} of {mirror.peer.host} has no place here: {error}")
        else:
            mirror.node = node
            mirror.refused = ""

    def _type_of(self, mirror: Mirror) -> "type[Message] | None":
        """Return the class of a mirror's definition, asking the peer for its text if need be."""
        from .. import messages

        advert = mirror.advert
        known = self._types.get(advert.type_hash)
        if known is not None:
            return known
        try:
            own = messages.type_for_topic(advert.topic)
        except UorbError:
            own = None
        if own is not None and own.__uorb__.type_hash == advert.type_hash:
            self._types[advert.type_hash] = own
            return own
        now = monotonic()
        if now - self._asked.get(advert.type_hash, -ASK_EVERY) >= ASK_EVERY:
            self._asked[advert.type_hash] = now
            self._say(mirror.peer, control.Ask(advert.topic, advert.instance, advert.type_hash))
        return None

    def _place(self, advert: Advert) -> int | None:
        """Return the number a remote instance gets here (under the directory lock); None: the lowest free."""
        directory = self._directory
        mapping = directory.find(advert.topic, advert.instance, populate=False)
        if mapping is None or not members.advertised(directory, mapping):
            return advert.instance
        if advert.shared and not members.owned(directory, mapping):
            return advert.instance
        return None

    def _refuse(self, mirror: Mirror, reason: str) -> None:
        if mirror.refused != reason:
            mirror.refused = reason
            self._mismatched += 1
            text = f"{mirror.name} of {mirror.peer.host} is refused: {reason}"
            self._events.add("definition", text, peer=mirror.peer.host, topic=mirror.advert.topic)
            self._say(mirror.peer, control.Refused(mirror.advert.topic, mirror.advert.instance, reason))

    def _once(self, mirror: Mirror, kind: str, text: str) -> None:
        if mirror.refused != text:
            mirror.refused = text
            self._events.add(kind, text, peer=mirror.peer.host, topic=mirror.advert.topic)

    def _yield_to_local(self, mirror: Mirror) -> None:
        """A local user came with another definition: its use wins, the mirror goes."""
        self._withdraw(mirror)
        self._install(mirror)

    def _withdraw(self, mirror: Mirror) -> None:
        node = mirror.node
        if node is None:
            return
        mirror.node = None
        if mirror.demand_us is not None:
            mirror.end()
            self.channel.remove_subscription(mirror.peer, mirror.advert.topic, mirror.advert.instance)
        try:
            members.unadvertise(node, mirror.peer.host)
        except (BusError, ClosedError) as error:
            log.warning("%s: %s could not be withdrawn: %s", self.host, mirror.name, error)

    def _drop_mirror(self, key: Key) -> None:
        mirror = self._mirrors.pop(key)
        self._withdraw(mirror)
        self._retransmitted += mirror.retransmitted
        self._thinned_before += mirror.thinned

    def _add_subscription(self, peer: Peer, topic: str, instance: int, interval_us: int) -> None:
        node = self._nodes.get((topic, instance))
        if node is not None and peer in self._present:
            self._sent += node.subscribe(peer, interval_us, self.channel)

    def _remove_subscription(self, peer: Peer, topic: str, instance: int) -> None:
        node = self._nodes.get((topic, instance))
        if node is not None:
            node.flows.pop(peer, None)
