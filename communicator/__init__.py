"""What carries topics between hosts: PX4's uORBCommunicator verbs and their implementations.

This package knows nothing of `uorb_net`. Zenoh is imported when a channel is started, not before.
"""

from typing import TYPE_CHECKING

from communicator.channel import Advert, Channel, ChannelError, ChannelHandler, Peer, SampleHeader

if TYPE_CHECKING:
    from communicator.memory import MemoryChannel, MemoryNetwork
    from communicator.zenoh_channel import ZenohChannel

__all__ = [
    "Advert",
    "Channel",
    "ChannelError",
    "ChannelHandler",
    "MemoryChannel",
    "MemoryNetwork",
    "Peer",
    "SampleHeader",
    "ZenohChannel",
]

_LAZY = {
    "MemoryChannel": "communicator.memory",
    "MemoryNetwork": "communicator.memory",
    "ZenohChannel": "communicator.zenoh_channel",
}


def __getattr__(name: str) -> object:
    if name not in _LAZY:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from importlib import import_module

    value: object = getattr(import_module(_LAZY[name]), name)
    globals()[name] = value
    return value
