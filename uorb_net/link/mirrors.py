"""All mirrors of a link: giving remote instances a place on this bus, and asking for what is wanted here."""

from collections.abc import Callable, Mapping
from logging import getLogger
from time import monotonic
from typing import TYPE_CHECKING

from communicator import Advert, Channel, Peer

from ..broker import members
from ..broker.directory import Directory
from ..broker.layout import GENERATION, W_G, W_LAPSED
from ..errors import BusError, ClosedError, InstanceError, TopicMismatchError, UorbError
from . import control
from .events import Events
from .incoming import Mirror
from .outgoing import LocalNode
from .peers import PeerState

if TYPE_CHECKING:
    from ..messages import Message

ASK_EVERY = 0.5  # seconds between two requests for a definition

Key = tuple[Peer, str, int]
Say = Callable[[Peer, control.Control], None]

log = getLogger("uorb_net.link")


class Mirrors:
    """The remote topic instances a link knows; steered by its thread alone."""

    def __init__(self, directory: Directory, channel: Channel, events: Events, say: Say) -> None:
        self.all: dict[Key, Mirror] = {}
        self.mismatched = 0
        self.retransmitted = self.thinned = 0  # of mirrors that are gone
        self._directory = directory
        self._channel = channel
        self._events = events
        self._say = say
        self._types: dict[str, type[Message]] = {}  # by hash
        self._asked: dict[str, float] = {}  # by hash: when its definition was asked for last
        self._cut: dict[Key, int] = {}  # newest numbers of streams that a cut ended under a living subscription

    # -- what peers announce -----------------------------------------------------------------------

    def announced(self, state: PeerState, advert: Advert) -> None:
        """Take an advertisement; one that changed replaces the former."""
        key = (state.peer, advert.topic, advert.instance)
        known = self.all.get(key)
        if known is not None and known.advert == advert:
            return
        self.drop(key)
        mirror = self.all[key] = Mirror(state, advert)
        newest = self._cut.pop(key, None)
        if newest is not None:
            mirror.resume(newest)
        self._install(mirror)

    def drop(self, key: Key) -> None:
        """Forget an advertisement, if it is known."""
        mirror = self.all.pop(key, None)
        if mirror is not None:
            self._withdraw(mirror)
            self.retransmitted += mirror.retransmitted
            self.thinned += mirror.thinned

    def drop_peer(self, peer: Peer) -> None:
        """Forget all that a peer announced, but not how far its streams had come: it may only be cut off.

        What it publishes meanwhile counts as lost for a living subscription of every sample. Of a limited
        one nobody can tell what it would have got.
        """
        self._cut = {key: newest for key, newest in self._cut.items() if key[0].host != peer.host}
        for key in [key for key in self.all if key[0] == peer]:
            mirror = self.all[key]
            if mirror.demand_us == 0 and not mirror.base:
                self._cut[key] = mirror.newest
            self.drop(key)

    def drop_all(self) -> None:
        """Forget everything."""
        for key in list(self.all):
            self.drop(key)

    def learn(self, message: control.Text) -> None:
        """Take a definition that was asked for.

        Raises:
            UorbError: it cannot be used, or is not what was announced.
        """
        from .. import messages

        if message.type_hash not in self._asked:
            return
        cls = messages.from_text(message.type_name, message.definition)
        if cls.__uorb__.type_hash != message.type_hash:
            raise UorbError(f"the definition of {message.type_name} is not the one that was announced")
        self._types[message.type_hash] = cls

    # -- what this host wants ----------------------------------------------------------------------

    def follow(self, nodes: Mapping[tuple[str, int], LocalNode]) -> None:
        """Ask for what somebody here subscribes to, at the fastest rate wanted; stop asking for the rest."""
        for mirror in list(self.all.values()):
            if mirror.node is None:
                self._install(mirror)
                continue
            label = mirror.node.label
            local = nodes.get((label.topic, label.instance))
            if local is None:
                continue
            if local.label.type_hash != mirror.advert.type_hash:
                # A local user came with another definition: its use wins, the mirror goes.
                self._withdraw(mirror)
                self._install(mirror)
            else:
                self._demand(mirror, local.interval_us if local.subscribers else None)

    def _demand(self, mirror: Mirror, interval_us: int | None) -> None:
        if interval_us == mirror.demand_us:
            if interval_us is None:
                mirror.end()  # the subscription that lived before a cut does not any more
            return
        if not mirror.state.measured and interval_us is not None:
            return  # its first sample would have no time in this host's clock; `follow` comes again with it
        where = (mirror.peer, mirror.advert.topic, mirror.advert.instance)
        if interval_us is None:
            mirror.end()
            self._channel.remove_subscription(*where)
            assert mirror.node is not None
            words = mirror.node.mapping.words
            words[W_LAPSED] = words[W_G] & GENERATION
        else:
            if mirror.demand_us is None:
                mirror.begin()
            mirror.demand_us = interval_us
            self._channel.add_subscription(*where, interval_us)

    # -- a mirror's place on this bus --------------------------------------------------------------

    def _install(self, mirror: Mirror) -> None:
        """Give a mirror its node, as soon as its definition is known and nothing forbids it."""
        cls = self._type_of(mirror)
        if cls is None:
            return
        advert = mirror.advert
        who = f"{mirror.name} of {mirror.peer.host}"
        try:
            with self._directory.hold():
                node = members.advertise(
                    self._directory,
                    cls.__uorb__,
                    advert.topic,
                    self._place(advert),
                    priority=advert.priority,
                    queue_length=advert.queue_length,
                    host=mirror.peer.host,
                    own=not advert.shared,
                )
                mirror.origin = node.mapping.origin_index(mirror.peer.host)
        except TopicMismatchError as error:
            if self._once(mirror, "definition", f"{who} is refused: {error}"):
                self.mismatched += 1
                self._say(mirror.peer, control.Refused(advert.topic, advert.instance, str(error)))
        except InstanceError as error:
            self._once(mirror, "instance", f"{who} is ignored: {error}")
        except BusError as error:
            self._once(mirror, "config", f"{who} has no place here: {error}")
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
        if advert.type_hash not in self._asked:  # searching for what is not installed takes milliseconds
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

    def _once(self, mirror: Mirror, kind: str, text: str) -> bool:
        """Report why a mirror has no place, unless it is known; True if it was news."""
        if mirror.refused == text:
            return False
        mirror.refused = text
        self._events.add(kind, text, peer=mirror.peer.host, topic=mirror.advert.topic)
        return True

    def _withdraw(self, mirror: Mirror) -> None:
        node = mirror.node
        if node is None:
            return
        mirror.node = None
        if mirror.demand_us is not None:
            mirror.end()
            self._channel.remove_subscription(mirror.peer, mirror.advert.topic, mirror.advert.instance)
        try:
            members.unadvertise(node, mirror.peer.host)
        except (BusError, ClosedError) as error:
            log.warning("%s of %s could not be withdrawn: %s", mirror.name, mirror.peer.host, error)
