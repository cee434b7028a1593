"""Waiting for a topic's definition: the publisher's, which tools show and play, else the installed one."""

from time import monotonic, sleep
from typing import TYPE_CHECKING

from ..errors import UnknownTopicError
from .carried import LOOK, Bus

if TYPE_CHECKING:
    from ..messages import Message


def type_in_use(bus: Bus, topic: str, instance: int, deadline: float) -> "type[Message]":
    """Return a topic's type: the publisher's, else the installed one, else any the bus remembers.

    Waits until `deadline` (of `monotonic`) for the bus, or a peer of the own link, to bring one.

    Raises:
        UnknownTopicError: there is none when the deadline comes.
    """
    while True:
        late = monotonic() >= deadline
        found = bus.broker.type_on_bus(topic, instance)
        if found is not None and bus.broker.advertised(topic):
            return found
        if late or not bus.expects_news():
            try:
                return bus.broker.resolve(topic, instance)[1]
            except UnknownTopicError:
                if late:
                    raise
        sleep(LOOK)
