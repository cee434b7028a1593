"""The local broker: nodes in flat buffers, shared by every process of a host or kept in one."""

from .broker import ORB_QUEUE_LENGTH_MAX, Broker, Priority
from .survey import TopicStatus

__all__ = ["ORB_QUEUE_LENGTH_MAX", "Broker", "Priority", "TopicStatus"]
