"""What this host offers and sends: local nodes as the directory shows them, flows to peers that asked.

A flow is one peer's subscription to one local node. The node's ring is the only queue: each flow
remembers how far it has read, and what an interval held back is told along as a number.
"""

from time import monotonic

from communicator import Advert, Channel, Peer, SampleHeader

from ..broker.directory import Directory
from ..broker.layout import GENERATION, MOVED, UNADVERTISED, W_FLOOR, W_G, W_REMOTE, Label
from ..broker.mapping import Mapping
from ..broker.slots import Sample, read
from ..broker.tables import shares, subscriber_entries
from ..clock import hrt_absolute_time
from . import control

HEADS_FOR = 4.0  # seconds: longer than a cut that the default lease survives


class Flow:
    """What one peer gets of one node."""

    __slots__ = ("base", "changed", "held", "interval_us", "last_us", "latched", "peer", "sequence")

    def __init__(self, peer: Peer, interval_us: int, base: int) -> None:
        self.peer = peer
        self.interval_us = interval_us
        self.last_us = 0
        self.base = base  # the publication before the first that this flow owes its peer
        self.sequence = base  # the newest sent
        self.changed = monotonic()  # when that changed, for how long to repeat it
        self.latched = 0  # the number that went out as latched, when the flow began
        self.held = False  # a newer sample waits for the interval to pass

    def due(self, now_us: int) -> bool:
        """Tell whether the interval has passed."""
        return now_us - self.last_us >= self.interval_us

    def passed(self, now_us: int) -> None:
        """Note a delivery: lateness is credited to the next (uorb-semantics, "Intervals")."""
        interval = self.interval_us
        self.last_us = min(max(self.last_us + interval, now_us - interval), now_us)


class LocalNode:
    """A node of this host's bus, watched by the link."""

    def __init__(self, mapping: Mapping) -> None:
        self.mapping = mapping
        self.label: Label = mapping.label()
        self.advert: Advert | None = None  # as announced
        self.flows: dict[Peer, Flow] = {}
        self.seen = mapping.words[W_G]  # G when the node was last read; the link's sleep looks at it
        self.position = self.seen & GENERATION
        self.subscribers = 0
        self.interval_us = 0

    def look(self, directory: Directory) -> None:
        """Read who subscribes here, and how fast the fastest wants it."""
        words = self.mapping.words
        living = [i for i in subscriber_entries(words) if words[i + 1] & 0xFFFFFFFF and directory.alive(words[i])]
        self.subscribers = len(living)
        self.interval_us = min((words[index + 2] for index in living), default=0)

    def offer(self, directory: Directory) -> Advert | None:
        """Return what is to be announced of this node: None unless a live local publisher advertises it."""
        words = self.mapping.words
        if words[W_G] & UNADVERTISED:
            return None
        local = [s for s in shares(words) if not s.origin and directory.alive(s.process)]
        if not local:
            return None
        label = self.label
        return Advert(
            label.topic,
            label.instance,
            label.type_name,
            label.type_hash,
            self.mapping.length,
            self.mapping.queue_length,
            local[0].priority,
            not any(share.own for share in local),
        )

    # -- flows -------------------------------------------------------------------------------------

    def subscribe(self, peer: Peer, interval_us: int, channel: Channel) -> int:
        """Start or change a peer's flow; a new one gets the newest sample, latched. Samples sent."""
        flow = self.flows.get(peer)
        if flow is not None:
            flow.interval_us = interval_us
            return 0
        if not self.flows:
            self.position = self.mapping.words[W_G] & GENERATION
        newest = self._newest()
        base = self.position - self.mapping.words[W_REMOTE] if newest is None else newest.sequence - 1
        flow = self.flows[peer] = Flow(peer, interval_us, base)
        if newest is None:
            return 0
        flow.passed(hrt_absolute_time())
        flow.latched = newest.sequence
        return self._send(flow, newest, channel)

    def _newest(self) -> Sample | None:
        """Return the newest local sample of the present advertisement before the position."""
        words = self.mapping.words
        oldest = max(self.position - self.mapping.slots + 1, words[W_FLOOR])
        for number in range(self.position - 1, oldest - 1, -1):
            sample = read(self.mapping, number)
            if sample is not None and not sample.origin:
                return sample
        return None

    def send_due(self, channel: Channel, now_us: int) -> int:
        """Send what is new, and what an interval held back that is due now. Samples sent."""
        sent = 0
        self.seen = self.mapping.words[W_G]
        generation = self.seen & GENERATION
        if generation != self.position:
            # What the ring has overwritten shows as a jump in the numbers, and counts as loss there.
            first = max(self.position, generation - self.mapping.slots + 1)
            for number in range(first, generation):
                sample = read(self.mapping, number)
                if sample is not None and not sample.origin:
                    sent += self._offer_sample(sample, channel, now_us)
            self.position = generation
        for flow in self.flows.values():
            if flow.held and flow.due(now_us):
                newest = self._newest()
                if newest is not None:
                    flow.passed(now_us)
                    sent += self._send(flow, newest, channel)
                flow.held = False
        return sent

    def _offer_sample(self, sample: Sample, channel: Channel, now_us: int) -> int:
        sent = 0
        for flow in self.flows.values():
            if not flow.interval_us:
                sent += self._send(flow, sample, channel)
            elif flow.due(now_us):
                flow.passed(now_us)
                flow.held = False
                sent += self._send(flow, sample, channel)
            else:
                flow.held = True
        return sent

    def _send(self, flow: Flow, sample: Sample, channel: Channel) -> int:
        if sample.sequence <= flow.sequence:
            return 0
        withheld = sample.sequence - flow.sequence - 1 if flow.interval_us else 0
        flow.sequence = sample.sequence
        flow.changed = monotonic()
        self._put(flow, sample, withheld, channel)
        return 1

    def _put(self, flow: Flow, sample: Sample, withheld: int, channel: Channel) -> None:
        age_us = max(hrt_absolute_time() - sample.published_us, 0)
        latched = sample.sequence == flow.latched
        header = SampleHeader(sample.sequence, sample.published_us, age_us, withheld, latched)
        channel.send_message(flow.peer, self.label.topic, self.label.instance, header, sample.payload)

    def resend(self, peer: Peer, first: int, last: int, channel: Channel) -> int:
        """Send publications `first` to `last` once more, as far as the ring still has them."""
        sent = 0
        flow = self.flows.get(peer)
        if flow is None:
            return 0
        generation = self.mapping.words[W_G] & GENERATION
        for number in range(max(generation - self.mapping.slots + 1, 0), generation):
            sample = read(self.mapping, number)
            if sample is not None and not sample.origin and first <= sample.sequence <= last:
                self._put(flow, sample, 0, channel)
                sent += 1
        return sent

    def changed_flows(self, now: float) -> list[Flow]:
        """Return the flows whose newest number is worth repeating (`now`: monotonic seconds)."""
        return [flow for flow in self.flows.values() if now - flow.changed < HEADS_FOR]

    def continue_from(self, old: "LocalNode") -> None:
        """Take over what the link knew of the node's former buffer."""
        self.advert, self.flows, self.position = old.advert, old.flows, old.position

    def next_due_us(self) -> int | None:
        """Return when a sample that an interval held back is due; None if none waits."""
        return min((f.last_us + f.interval_us for f in self.flows.values() if f.held), default=None)

    @property
    def moved(self) -> bool:
        """Whether another buffer took this one's name."""
        return bool(self.mapping.words[W_G] & MOVED)


class Offers:
    """All nodes of this host's bus, as the link announces and sends them; steered by its thread alone."""

    def __init__(self, directory: Directory, channel: Channel) -> None:
        self.nodes: dict[tuple[str, int], LocalNode] = {}
        self.sent = 0
        self._directory = directory
        self._channel = channel
        self._flowing: list[LocalNode] = []

    def survey(self) -> None:
        """Follow the directory: announce what appeared, take back what went."""
        names = set(self._directory.names())
        for key in [key for key in self.nodes if key not in names]:
            self._forget(key)
        for key in names:
            node = self.nodes.get(key)
            if node is None or node.moved:
                node = self._open(key, node)
            if node is not None:
                self._follow(key, node)

    def _open(self, key: tuple[str, int], old: LocalNode | None) -> LocalNode | None:
        mapping = self._directory.find(*key, populate=False)
        if mapping is None:
            return None
        node = LocalNode(mapping)
        if old is not None and old.label.type_hash == node.label.type_hash:
            node.continue_from(old)
        elif old is not None:
            self._forget(key)
        self.nodes[key] = node
        self._note_flowing()
        return node

    def _follow(self, key: tuple[str, int], node: LocalNode) -> None:
        node.look(self._directory)
        advert = node.offer(self._directory)
        if advert == node.advert:
            return
        node.advert = advert
        if advert is not None:
            self._channel.topic_advertised(advert)
        else:
            self._channel.topic_unadvertised(*key)

    def _forget(self, key: tuple[str, int]) -> None:
        node = self.nodes.pop(key)
        if node.advert is not None:
            self._channel.topic_unadvertised(*key)
        self._note_flowing()

    def _note_flowing(self) -> None:
        self._flowing = [node for node in self.nodes.values() if node.flows]

    # -- peers' wishes -----------------------------------------------------------------------------

    def subscribe(self, peer: Peer, topic: str, instance: int, interval_us: int) -> None:
        """Start or change a peer's flow."""
        node = self.nodes.get((topic, instance))
        if node is not None:
            self.sent += node.subscribe(peer, interval_us, self._channel)
            self._note_flowing()

    def unsubscribe(self, peer: Peer, topic: str, instance: int) -> None:
        """End a peer's flow."""
        node = self.nodes.get((topic, instance))
        if node is not None:
            node.flows.pop(peer, None)
            self._note_flowing()

    def drop_peer(self, peer: Peer) -> None:
        """End all flows of a peer."""
        for node in self._flowing:
            node.flows.pop(peer, None)
        self._note_flowing()

    def resend(self, peer: Peer, message: control.Gap) -> None:
        """Answer a request for what a peer missed."""
        node = self.nodes.get((message.topic, message.instance))
        if node is not None:
            self.sent += node.resend(peer, message.first, message.last, self._channel)

    # -- sending -----------------------------------------------------------------------------------

    def send_due(self) -> None:
        """Queue what is new or due in every flowing node."""
        now_us = hrt_absolute_time()
        for node in self._flowing:
            self.sent += node.send_due(self._channel, now_us)

    def arm(self, number: int) -> bool:
        """Announce sleeper `number` in every flowing node; False if one has moved on meanwhile."""
        for node in self._flowing:
            self._directory.arm(node.mapping.words, number)
        return all(node.mapping.words[W_G] == node.seen for node in self._flowing)

    def due_in(self) -> float | None:
        """Return the seconds until a held-back sample is due; None if none waits."""
        due = [when for node in self._flowing if (when := node.next_due_us()) is not None]
        return (min(due) - hrt_absolute_time()) / 1e6 if due else None

    def heads(self, now: float) -> dict[Peer, list[tuple[str, int, int, int]]]:
        """Return the numbers worth repeating, by peer (`now`: monotonic seconds): see `control.Heads`."""
        heads: dict[Peer, list[tuple[str, int, int, int]]] = {}
        for node in self._flowing:
            for flow in node.changed_flows(now):
                row = (node.label.topic, node.label.instance, flow.base, flow.sequence)
                heads.setdefault(flow.peer, []).append(row)
        return heads
