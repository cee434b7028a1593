"""PX4's uORB for Python: one bus shared by every process of a host, mirrored between hosts over Zenoh.

Names load when first used, so that `import uorb_net` costs little and a program that stays on one
host never imports the network.
"""

from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

if TYPE_CHECKING:
    from . import messages as messages
    from . import msg as msg
    from . import orb as orb
    from .broker import ORB_QUEUE_LENGTH_MAX as ORB_QUEUE_LENGTH_MAX
    from .broker import Broker as Broker
    from .broker import Priority as Priority
    from .broker import TopicStatus as TopicStatus
    from .clock import hrt_absolute_time as hrt_absolute_time
    from .errors import BusError as BusError
    from .errors import BusyError as BusyError
    from .errors import ClosedError as ClosedError
    from .errors import DecodeError as DecodeError
    from .errors import DefinitionError as DefinitionError
    from .errors import EncodeError as EncodeError
    from .errors import InstanceError as InstanceError
    from .errors import LinkError as LinkError
    from .errors import NoDataError as NoDataError
    from .errors import QueueLengthError as QueueLengthError
    from .errors import ServiceError as ServiceError
    from .errors import SpinnerError as SpinnerError
    from .errors import TopicMismatchError as TopicMismatchError
    from .errors import UnknownTopicError as UnknownTopicError
    from .errors import UorbError as UorbError
    from .link import Link as Link
    from .link import LinkEvent as LinkEvent
    from .link import LinkStats as LinkStats
    from .link import PeerStatus as PeerStatus
    from .link import TopicLinkStats as TopicLinkStats
    from .publication import Publication as Publication
    from .subscription import Sample as Sample
    from .subscription import SampleInfo as SampleInfo
    from .subscription import Subscription as Subscription
    from .waiting import poll as poll

_HOMES = {
    "clock": ["hrt_absolute_time"],
    "broker": ["Broker", "Priority", "ORB_QUEUE_LENGTH_MAX", "TopicStatus"],
    "link": ["Link", "LinkEvent", "LinkStats", "PeerStatus", "TopicLinkStats"],
    "publication": ["Publication"],
    "subscription": ["Subscription", "Sample", "SampleInfo"],
    "waiting": ["poll"],
    "errors": [
        "UorbError", "UnknownTopicError", "NoDataError", "InstanceError", "TopicMismatchError", "ClosedError",
        "QueueLengthError", "DefinitionError", "EncodeError", "DecodeError", "BusyError", "BusError",
        "LinkError", "SpinnerError", "ServiceError",
    ],
}  # fmt: skip
_HOME = {name: home for home, names in _HOMES.items() for name in names}
_MODULES = ("messages", "msg", "orb")
__all__ = ["__version__", *_MODULES, *_HOME]  # noqa: PLE0604 - names load through __getattr__


def __getattr__(name: str) -> Any:
    from importlib import import_module

    if name in _MODULES:
        return import_module(f"{__name__}.{name}")
    home = _HOME.get(name)
    if home is None:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(f"{__name__}.{home}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
