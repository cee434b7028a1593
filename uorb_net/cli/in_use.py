"""Definitions as they are in force on the bus, and how to join a node with one.

`Broker` knows a topic by what is installed here first. Tools show and play what others publish, so they
take the publisher's definition, and name the instance they publish on.
"""

from time import monotonic, sleep
from typing import TYPE_CHECKING, Any

from ..broker import members
from ..broker.broker import Broker, Priority
from ..errors import UnknownTopicError
from ..publication import Publication
from ..subscription import Subscription
from .carried import LOOK, Bus

if TYPE_CHECKING:
    from ..broker.mapping import Mapping
    from ..messages import Message


def is_advertised(broker: Broker, topic: str, instance: int) -> bool:
    """Tell whether somebody alive advertises the instance, whatever its definition."""
    mapping = _find(broker, topic, instance)
    return mapping is not None and members.advertised(broker._directory, mapping)


def type_in_use(bus: Bus, topic: str, instance: int, deadline: float) -> "type[Message]":
    """Return a topic's type: the publisher's, else the installed one, else any the bus remembers.

    Waits until `deadline` (of `monotonic`) for the bus, or a peer of the own link, to bring one.

    Raises:
        UnknownTopicError: there is none when the deadline comes.
    """
    from .. import messages

    installed, unknown = None, None
    try:
        installed = messages.type_for_topic(topic)
    except UnknownTopicError as error:
        unknown = error
    while True:
        late = monotonic() >= deadline
        found = _type_on_bus(bus.broker, topic, instance, living=installed is not None)
        if found is None and (late or not bus.expects_news()):
            found = installed
        if found is not None:
            return found
        if late:
            assert unknown is not None
            raise unknown
        sleep(LOOK)


def _type_on_bus(broker: Broker, topic: str, instance: int, *, living: bool) -> "type[Message] | None":
    """Return the type of a topic's node; `living`: of one that somebody advertises."""
    from .. import messages

    for known in (instance, *range(members.INSTANCES)):
        mapping = _find(broker, topic, known)
        if mapping is not None and (not living or members.advertised(broker._directory, mapping)):
            label = mapping.label()
            return messages.from_text(label.type_name, label.definition)
    return None


def _find(broker: Broker, topic: str, instance: int) -> "Mapping | None":
    # A topic that is no identifier could be a path out of the bus's folder.
    return broker._directory.find(topic, instance, populate=False) if topic.isidentifier() else None


def subscribe_as(
    broker: Broker, type_: "type[Message]", topic: str, instance: int, *, interval: float = 0.0
) -> Subscription[Any]:
    """Subscribe with a type that need not be the installed one; errors as `Broker.subscribe`."""
    node = members.subscribe(broker._directory, type_.__uorb__, topic, instance)
    subscription: Subscription[Any] = Subscription(node, "latest", interval, broker._users.discard)
    broker._users.add(subscription)
    return subscription


def advertise_as(
    broker: Broker, type_: "type[Message]", topic: str, instance: int, *, queue_length: int | None = None
) -> Publication[Any]:
    """Advertise one instance by its number, with a type that need not be the installed one.

    Instance 0 is shared, as `Broker.advertise` has it; the others are own, as `advertise_multi` has them.
    """
    node = members.advertise(
        broker._directory,
        type_.__uorb__,
        topic,
        instance,
        priority=Priority.DEFAULT,
        queue_length=queue_length,
        own=instance > 0,
    )
    publication: Publication[Any] = Publication(node, Priority.DEFAULT, broker._users.discard)
    broker._users.add(publication)
    return publication
