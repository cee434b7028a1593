"""The bus joined to a network: uORB's Manager seen from outside."""

from .link import Link
from .status import LinkEvent, LinkStats, PeerStatus, TopicLinkStats

__all__ = ["Link", "LinkEvent", "LinkStats", "PeerStatus", "TopicLinkStats"]
