"""The channel between hosts: PX4's verbs over Eclipse Zenoh. docs/wire.md has the wire."""

import atexit
import os
from collections.abc import Iterable, Mapping
from weakref import WeakSet

from communicator.channel import ChannelError, ChannelHandler, Peer
from communicator.counters import Counters
from communicator.node import Node, NodeChannel
from communicator.session import check_options
from communicator.zenoh_node import ZenohNode, open_nodes

_channels: "WeakSet[ZenohChannel]" = WeakSet()
_orphans: list[ZenohNode] = []


class ZenohChannel(NodeChannel):
    """A Channel over Zenoh, of a full mesh of peers, or of clients of a router.

    Args:
        listen: endpoints to accept on, such as `tcp/0.0.0.0:7447`.
        connect: endpoints to reach, tried for ever; one's own is left out, so all hosts can carry
            the same list.
        mode: `peer`; `client` of a router, which may come later; or `router`, a hub in this process.
        lease: seconds of silence after which the others take this host for gone; equal everywhere.
        tls: paths under the keys `ca`, `certificate` and `key`; both sides prove who they are.
        classes: kept for traffic classes by configuration; has no effect yet.
        multicast: look for others by multicast as well.
        config: a nested mapping of Zenoh's own configuration, merged over ours.

    Raises:
        ChannelError: an option is wrong.
    """

    def __init__(
        self,
        *,
        listen: Iterable[str] = (),
        connect: Iterable[str] = (),
        mode: str = "peer",
        lease: float = 2.0,
        tls: Mapping[str, str | os.PathLike[str]] | None = None,
        classes: Mapping[str, object] | None = None,
        multicast: bool = False,
        config: Mapping[str, object] | None = None,
    ) -> None:
        super().__init__()
        self._options = check_options(
            listen=listen,
            connect=connect,
            mode=mode,
            lease=lease,
            tls=tls,
            multicast=multicast,
            config=config,
        )
        self._classes = classes
        self._forked = False
        _channels.add(self)

    def _make_node(self, vehicle: str, own: Peer, handler: ChannelHandler, counters: Counters) -> Node:
        return ZenohNode(vehicle, own, handler, counters, self._options)

    def _check_process(self) -> None:
        if self._forked:
            raise ChannelError("this channel was made before fork; make a new one in a spawned process")

    def _started(self) -> Node:
        self._check_process()
        return super()._started()

    def register_handler(self, handler: ChannelHandler) -> None:
        self._check_process()
        super().register_handler(handler)

    def start(self, vehicle: str, host: str) -> None:
        self._check_process()
        super().start(vehicle, host)

    def stop(self) -> None:
        if not self._forked:  # of a forked copy nothing runs that could be stopped
            super().stop()

    def counters(self) -> Mapping[str, int]:
        self._check_process()  # another thread may have held the totals' lock at the fork
        return super().counters()


def _mark_forked() -> None:
    # Never let the child collect a session: closing it would wait for threads it has not got.
    _orphans.extend(open_nodes)
    open_nodes.clear()
    for channel in _channels:
        channel._forked = True


def _close_all() -> None:
    # A daemon thread inside Zenoh that wakes while the interpreter is torn down aborts the process.
    for node in list(open_nodes):
        node.close()


atexit.register(_close_all)
os.register_at_fork(after_in_child=_mark_forked)
