"""What every node of a bus looks like from outside: for `topics`, `top`, `ls` and the link."""

import msgspec

from .directory import Directory
from .layout import GENERATION, MOVED, UNADVERTISED, W_FLOOR, W_G, W_NETLOST, W_PRIORITY, Label
from .mapping import Mapping
from .slots import read
from .tables import shares, subscriber_entries, total_lost


class TopicStatus(msgspec.Struct, frozen=True, kw_only=True):
    """One node of the bus at one moment.

    `type` is the message's name; `publishers` and `subscribers` count the living of this host (mirrors
    of remote publishers count as publishers); `generation` counts writes; `lost` sums what all
    subscriptions lost; `origin` is the publisher's host.
    """

    topic: str
    instance: int
    type: str
    type_hash: str
    advertised: bool
    publishers: int
    subscribers: int
    queue_length: int
    generation: int
    lost: int
    priority: int
    origin: str


class Survey(msgspec.Struct, frozen=True):
    """A node's status with what only tools ask.

    `size`: encoded bytes; `received_us`: of the last write, 0 for never; `link_lost`: lost on the network.
    """

    status: TopicStatus
    size: int
    received_us: int
    link_lost: int
    label: Label


def survey(directory: Directory) -> list[Survey]:
    """Look at every node, sorted by topic and instance; processes that died are not counted."""
    lives: dict[int, bool] = {}

    def alive(process: int) -> bool:
        if process not in lives:
            lives[process] = directory.alive(process)
        return lives[process]

    found = []
    for topic, instance in directory.names():
        node = directory.nodes.get((topic, instance))
        mapping = node.mapping if node is not None else None
        if mapping is None or mapping.words[W_G] & MOVED:
            mapping = directory.find(topic, instance, populate=False)
        if mapping is not None:
            found.append(_look(directory, mapping, {p for p in _processes(mapping) if alive(p)}))
    return found


def _processes(mapping: Mapping) -> set[int]:
    words = mapping.words
    return {share.process for share in shares(words)} | {words[index] for index in subscriber_entries(words)}


def _look(directory: Directory, mapping: Mapping, living: set[int]) -> Survey:
    words = mapping.words
    label = mapping.label()
    publishing = [share for share in shares(words) if share.process in living]
    subscribing = [words[i + 1] & 0xFFFFFFFF for i in subscriber_entries(words) if words[i] in living]
    origin = min((share.origin for share in publishing), default=0)
    status = TopicStatus(
        topic=label.topic,
        instance=label.instance,
        type=label.type_name,
        type_hash=label.type_hash,
        advertised=bool(publishing) and not words[W_G] & UNADVERTISED,
        publishers=sum(share.publications for share in publishing),
        subscribers=sum(subscribing),
        queue_length=mapping.queue_length,
        generation=words[W_G] & GENERATION,
        lost=total_lost(words),
        priority=words[W_PRIORITY],
        origin=mapping.origin(origin) or directory.host,
    )
    return Survey(status, mapping.length, last_write(mapping), words[W_NETLOST], label)


def last_write(mapping: Mapping) -> int:
    """Return when the node was last written, µs of this host's clock; 0 for never or being overtaken."""
    generation = mapping.words[W_G] & GENERATION
    if not generation or generation < mapping.words[W_FLOOR]:
        return 0
    slot = read(mapping, generation - 1)
    return 0 if slot is None else slot.received_us
