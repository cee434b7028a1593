"""Joining and leaving a node: advertise, unadvertise, subscribe, unsubscribe, all under the directory lock.

Everything that changes tables or files goes through here, so whoever comes first makes the node,
the second finds it, and what dead processes left is cleared by the next one who passes.
"""

import errno
from typing import TYPE_CHECKING, Any

from ..errors import BusError, ClosedError, InstanceError, TopicMismatchError
from .directory import Directory
from .growth import replace, supersede
from .layout import GENERATION, MOVED, UNADVERTISED, W_FLOOR, W_G, Label, pick
from .mapping import Mapping
from .node import Node
from .tables import (
    Share,
    add_share,
    begin_advertisement,
    claim_subscriber,
    drop_share,
    purge,
    release_subscriber,
    shares,
    subscriber_entries,
)

if TYPE_CHECKING:
    from ..messages import MessageType
    from ..subscription import Subscription

INSTANCES = 10


def open_node(directory: Directory, type_: "MessageType", topic: str, instance: int, queue_length: int) -> Node:
    """Return this process's `Node`, made on the bus if it is not there (under the directory lock).

    Raises:
        TopicMismatchError: a live local publisher or subscriber uses another definition.
    """
    node = directory.nodes.get((topic, instance))
    if node is not None and not _follow(node):
        node = None
    mapping = node.mapping if node is not None else _found(directory, topic, instance)
    label = Label(topic, instance, type_.name, type_.type_hash, type_.full_definition)
    if mapping is None:
        mapping = directory.install(label, pick(label, type_.payload_length, queue_length))
        directory.announce()
    elif mapping.label().type_hash != type_.type_hash:
        _refuse_mismatch(directory, mapping, type_)
        mapping = supersede(directory, mapping, label, pick(label, type_.payload_length, queue_length))
        node = None
    if node is None:
        node = directory.nodes[topic, instance] = Node(directory, label, type_, mapping)
    return node


def _found(directory: Directory, topic: str, instance: int) -> Mapping | None:
    mapping = directory.find(topic, instance)
    if mapping is not None and mapping.words[W_G] & MOVED:
        mapping.words[W_G] &= ~MOVED  # its mover was killed before the rename
    return mapping


def _refuse_mismatch(directory: Directory, mapping: Mapping, type_: "MessageType") -> None:
    """Raise if a live process of this host uses the node with its other definition."""
    words = mapping.words
    purge(words, directory.alive)
    local = [share.process for share in shares(words) if not share.origin]
    users = local or [words[index] for index in subscriber_entries(words)]
    if not users:
        return
    from ..messages import compare, from_text

    label = mapping.label()
    there = from_text(label.type_name, label.definition).__uorb__
    raise TopicMismatchError(
        f"topic {label.topic} is in use by process {directory.pid(users[0])} with another definition of "
        f"{label.type_name}: {compare(type_, there)}"
    )


def advertise(
    directory: Directory,
    type_: "MessageType",
    topic: str,
    instance: int | None,
    *,
    priority: int,
    queue_length: int | None,
    host: str = "",
    own: bool = False,
) -> Node:
    """Count one more publication in; `instance` None takes the lowest free one.

    `host` names the origin of a mirror's samples, "" is this host.
    """
    with directory.hold():
        if instance is None:
            instance = lowest_free(directory, topic)
        wanted = queue_length or type_.queue_length or 1
        node = open_node(directory, type_, topic, instance, wanted)
        node.users += 1
        try:
            _claim(node, Share(0, directory.me, 1, priority, 0, own), wanted, bool(queue_length), host)
        except BaseException:
            _release(node)
            raise
        node.publishing += 1
        node.settle_writers(newcomer=node.publishing == 1)
        directory.announce()
        return node


def _claim(node: Node, share: Share, wanted: int, explicit: bool, host: str) -> None:
    """Enter a publication into the node's table; `wanted` is its queue length, `explicit` where it was asked for."""
    purge(node.mapping.words, node.directory.alive)
    fresh = not any(shares(node.mapping.words))
    if wanted != node.mapping.queue_length and (fresh or (explicit and not readable(node.mapping))):
        replace(node, wanted, deepest(node.mapping))
    words = node.mapping.words
    if fresh:
        begin_advertisement(words, share.priority)
    add_share(words, node.name, share._replace(origin=node.mapping.origin_index(host) if host else 0))


def unadvertise(node: Node, host: str = "") -> None:
    """Count one publication out; the last one of the node unadvertises it."""
    directory = node.directory
    with directory.hold():
        node.publishing -= 1
        if not node.publishing:
            node.leave_writers()
        if _follow(node):
            mapping = node.mapping
            drop_share(mapping.words, directory.me, mapping.origin_index(host) if host else 0)
            purge(mapping.words, directory.alive)
            directory.announce()
        _release(node)


def subscribe(directory: Directory, type_: "MessageType", topic: str, instance: int) -> Node:
    """Open the node for a subscription; `enlist` counts it in."""
    with directory.hold():
        node = open_node(directory, type_, topic, instance, type_.queue_length or 1)
        node.users += 1
        return node


def give_up(node: Node) -> None:
    """Undo `subscribe` where `enlist` failed."""
    with node.directory.hold():
        _release(node)


def enlist(node: Node, subscription: "Subscription[Any]") -> None:
    """Count a subscription in, and again when its interval or depth has changed."""
    directory = node.directory
    with directory.hold():
        _follow(node)
        purge(node.mapping.words, directory.alive)
        node.subscriber = claim_subscriber(node.mapping.words, node.name, directory.me)
        node.subscriptions.add(subscription)
        if subscription.queue_size + 2 > node.mapping.slots:
            replace(node, node.mapping.queue_length, deepest(node.mapping, subscription.queue_size))
        if node.refresh_subscriber():
            directory.announce()


def unsubscribe(node: Node, subscription: "Subscription[Any]") -> None:
    """Count a subscription out."""
    directory = node.directory
    with directory.hold():
        node.subscriptions.discard(subscription)
        if _follow(node):
            if node.subscriptions:
                changed = node.refresh_subscriber()
            else:
                release_subscriber(node.mapping.words, node.subscriber)
                changed = True
            if changed:
                directory.announce()
        if not node.subscriptions:
            node.subscriber = 0
        _release(node)


def _follow(node: Node) -> bool:
    """Pick up a moved node's present buffer; False if another definition took its place."""
    if node.mapping.words[W_G] & MOVED:
        try:
            node.remap()
        except ClosedError:
            return False
    return True


def _release(node: Node) -> None:
    node.users -= 1
    directory = node.directory
    if not node.subscriptions:
        node.forget_sleepers(directory.own_ends())
    if not node.users:
        key = (node.label.topic, node.label.instance)
        if directory.nodes.get(key) is node:
            del directory.nodes[key]
        node.close()


def lowest_free(directory: Directory, topic: str) -> int:
    """Return the lowest instance that nobody alive advertises (under the directory lock)."""
    for instance in range(INSTANCES):
        node = directory.nodes.get((topic, instance))
        known = node is not None and _follow(node)
        mapping = node.mapping if node is not None and known else directory.find(topic, instance)
        if mapping is None or not advertised(directory, mapping):
            return instance
    raise InstanceError(f"{topic}: all {INSTANCES} instances are advertised")


def advertised(directory: Directory, mapping: Mapping) -> bool:
    """Tell whether a live process advertises a node. No lock needed."""
    if mapping.words[W_G] & UNADVERTISED:
        return False
    return any(directory.alive(share.process) for share in shares(mapping.words))


def owned(directory: Directory, mapping: Mapping) -> bool:
    """Tell whether a live publisher made with advertise_multi holds the node. No lock needed."""
    return any(share.own and directory.alive(share.process) for share in shares(mapping.words))


def readable(mapping: Mapping) -> bool:
    """Tell whether the present advertisement has data."""
    return (mapping.words[W_G] & GENERATION) > mapping.words[W_FLOOR]


def deepest(mapping: Mapping, wanted: int = 0) -> int:
    """Return the deepest retention that callback subscriptions of any process ask for."""
    words = mapping.words
    return max([wanted, *(words[index + 1] >> 32 for index in subscriber_entries(words))])


def bury(directory: Directory, node: Node) -> bool:
    """Clear what dead publishers left on a node; False if somebody lives or the lock is held elsewhere."""
    try:
        with directory.hold(wait=0.0):
            _follow(node)
            if purge(node.mapping.words, directory.alive):
                directory.sweep()
                directory.announce()
            return bool(node.mapping.words[W_G] & UNADVERTISED)
    except BusError as error:
        if error.errno != errno.EAGAIN:
            raise
        return True  # whoever holds the lock is slow; nobody alive publishes, which is what was asked
