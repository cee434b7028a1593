"""What this host offers and sends: local nodes as the directory shows them, flows to peers that asked.

A flow is one peer's subscription to one local node. The node's ring is the only queue: each flow
remembers how far it has read, and what an interval held back is told along as a number.
"""

from time import monotonic

from communicator import Advert, Channel, Peer, SampleHeader

from ..broker.directory import Directory
from ..broker.layout import GENERATION, MOVED, UNADVERTISED, W_FLOOR, W_G, Label
from ..broker.mapping import Mapping
from ..broker.slots import Sample, read
from ..broker.tables import shares, subscriber_entries
from ..clock import hrt_absolute_time

HEADS_FOR = 4.0  # seconds: longer than a cut that the default lease survives


class Flow:
    """What one peer gets of one node."""

    __slots__ = ("changed", "held", "interval_us", "last_us", "peer", "sequence")

    def __init__(self, peer: Peer, interval_us: int) -> None:
        self.peer = peer
        self.interval_us = interval_us
        self.last_us = 0
        self.sequence = 0  # of the newest sample sent; 0: none
        self.changed = 0.0  # when that was (monotonic seconds), for how long to repeat it
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
        living = [
            i for i in subscriber_entries(words) if words[i + 1] & 0xFFFFFFFF and directory.alive(words[i])
        ]
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
        flow = self.flows[peer] = Flow(peer, interval_us)
        newest = self._newest()
        if newest is None:
            return 0
        flow.passed(hrt_absolute_time())
        return self._send(flow, newest, channel, latched=True)

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

    def _send(self, flow: Flow, sample: Sample, channel: Channel, latched: bool = False) -> int:
        if sample.sequence <= flow.sequence:
            return 0
        withheld = sample.sequence - flow.sequence - 1 if flow.interval_us and flow.sequence else 0
        flow.sequence = sample.sequence
        flow.changed = monotonic()
        age_us = max(hrt_absolute_time() - sample.published_us, 0)
        header = SampleHeader(sample.sequence, sample.published_us, age_us, withheld, latched)
        label = self.label
        channel.send_message(flow.peer, label.topic, label.instance, header, sample.payload)
        return 1

    def resend(self, peer: Peer, first: int, last: int, channel: Channel) -> int:
        """Send publications `first` to `last` once more, as far as the ring still has them."""
        sent = 0
        if peer not in self.flows:
            return 0
        generation = self.mapping.words[W_G] & GENERATION
        for number in range(max(generation - self.mapping.slots + 1, 0), generation):
            sample = read(self.mapping, number)
            if sample is not None and not sample.origin and first <= sample.sequence <= last:
                age_us = max(hrt_absolute_time() - sample.published_us, 0)
                header = SampleHeader(sample.sequence, sample.published_us, age_us)
                channel.send_message(peer, self.label.topic, self.label.instance, header, sample.payload)
                sent += 1
        return sent

    def changed_flows(self, now: float) -> list[Flow]:
        """Return the flows whose newest number is worth repeating (`now`: monotonic seconds)."""
        return [flow for flow in self.flows.values() if flow.sequence and now - flow.changed < HEADS_FOR]

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
