"""Where a played log goes: the topics of a bus, deep enough that a recorder beside it drops nothing."""

from collections.abc import Callable
from typing import Any

from ..broker.broker import Broker
from ..errors import UorbError
from ..messages import Message, from_text, type_for_topic
from ..messages.compare import difference
from ..publication import Publication
from .player import Series

DEPTH = 255  # samples, while they fit in this many bytes:
DEPTH_BYTES = 1 << 20
DEPTH_LEAST = 64


class BusSink:
    """Publishes a log's series on a broker, under the log's instance numbers, with its definitions."""

    def __init__(self, broker: Broker, refused: Callable[[Series, UorbError], object]) -> None:
        """Publish on `broker`; `refused` hears of each series that cannot be advertised, and why."""
        self._broker = broker
        self._refused = refused
        self.rows = 0
        self._publications: dict[Series, Publication[Any]] = {}

    def advertise(self, series: Series) -> None:
        """Advertise a series, or report that it cannot be."""
        cls = _type_of(series)
        depth = queue_length(series.encoded_size)
        try:
            publication = self._broker.advertise_instance(cls, series.topic, series.instance, queue_length=depth)
        except UorbError as error:
            self._refused(series, error)
        else:
            self._publications[series] = publication

    def publish(self, series: Series, payload: bytes) -> None:
        """Publish the bytes as they are."""
        publication = self._publications.get(series)
        if publication is not None:
            publication.publish_encoded(payload)
            self.rows += 1

    @property
    def playing(self) -> int:
        """How many series are advertised."""
        return len(self._publications)

    def close(self) -> None:
        """Take every advertisement back."""
        for publication in self._publications.values():
            publication.unadvertise()
        self._publications.clear()


def queue_length(size: int) -> int:
    """Return how many samples of `size` bytes a played series keeps for its readers."""
    return min(DEPTH, max(DEPTH_LEAST, DEPTH_BYTES // size))


def _type_of(series: Series) -> type[Message]:
    """Return the installed type where its fields are the log's, else one from the log's definition.

    A log names topics, not types: `estimator_attitude` is a VehicleAttitude only for who knows.
    """
    logged = from_text(series.type_name, series.definition)
    try:
        installed = type_for_topic(series.topic)
    except UorbError:
        return logged
    same = difference(installed.__uorb__.schema, logged.__uorb__.schema) is None
    return installed if same else logged
