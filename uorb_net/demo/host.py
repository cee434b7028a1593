"""One host of the demo inside its process: bus, link, what it receives, its reports to the parent.

A thread listens to the parent. Its end of file, or "stop", ends the process, whatever the rest of it
is doing; where the parent is gone, the last process to go removes the demo's folder.
"""

import os
import shutil
import socket
import sys
from collections.abc import Callable
from contextlib import suppress
from queue import Empty, SimpleQueue
from threading import Event, Thread
from time import monotonic, process_time, sleep
from typing import Any

import msgspec

from communicator import ChannelError, ZenohChannel

from ..broker import Broker
from ..errors import LinkError, UorbError
from ..link import Link
from ..publication import Publication
from ..waiting import poll
from .receiver import Receiver
from .reports import QUIET, QUIET_EVERY, REPORT_EVERY, STOP, Attitude, Plan, Report

STOP_WAIT = 1.2  # seconds for an orderly end; then the process ends all the same
SIBLING_WAIT = 3.0  # seconds for the other host to leave the folder of a parent that is gone
LOOK_EVERY = 0.25  # seconds between two looks at the bus for new topics
FIRST_REPORT = 0.4  # seconds after the first sample
NAP = 0.05  # seconds: the parent's word is heard within this
PORT_TRIES = 5


class Stopped(Exception):  # noqa: N818 - not an error
    """The parent wants this process to end, or is gone."""


class Host:
    """A host's bus and link, and the parent's ear.

    Attributes:
        broker: the bus.
        receiver: reads from it what other hosts publish.
        quiet: whether the parent wants no more publications.
        done, problem: see `Report`.
        attitude: called for what the report says of the attitude.
    """

    def __init__(self, plan: Plan) -> None:
        self.plan = plan
        self.quiet = self.done = False
        self.problem = ""
        self.attitude: Callable[[], Attitude | None] = lambda: None
        self.published = 0
        self._parent = socket.socket(fileno=plan.socket)
        self._commands: SimpleQueue[str] = SimpleQueue()
        self._ended = Event()
        self._orphaned = False
        Thread(target=self._listen, name="demo-parent", daemon=True).start()
        self.broker = Broker()
        self.receiver = Receiver(self.broker)
        self._link: Link | None = None
        self._endpoint = ""  # where this host listens
        self._there = ""  # where the other one does
        self._looked = 0.0
        self._report_at = monotonic() + REPORT_EVERY
        self._used = (monotonic(), process_time())
        self._awaited = True  # no sample has come yet

    # -- the link ----------------------------------------------------------------------------------

    def listen(self) -> None:
        """Start the link on a free port of this machine, and tell the parent which."""
        for attempt in range(PORT_TRIES):
            self._endpoint = f"tcp/127.0.0.1:{free_port()}"
            try:
                self._start(ZenohChannel(listen=[self._endpoint]))
            except (LinkError, ChannelError):
                if attempt + 1 == PORT_TRIES:
                    raise
            else:
                break
        self._report()

    def connect(self) -> None:
        """Start the link to where the parent says the other host listens."""
        while not self._there:
            with suppress(Empty):
                self._obey(self._commands.get(timeout=NAP))
        self._start(ZenohChannel(connect=[self._there]))

    def _start(self, channel: ZenohChannel) -> None:
        self._link = Link(self.broker, channel, host=self.plan.host).start()

    # -- the parent --------------------------------------------------------------------------------

    def _listen(self) -> None:
        """Take the parent's commands; see to it that the process ends (thread)."""
        command = b""
        while command != STOP.encode():
            try:
                command = self._parent.recv(4096)
            except OSError:
                command = b""
            if not command:
                self._orphaned = True
                break
            self._commands.put(command.decode())
        self._commands.put(STOP)
        if not self._ended.wait(STOP_WAIT):
            self._leave()
            os._exit(1)

    def _obey(self, command: str) -> None:
        """Follow a command. Raises Stopped."""
        if command == STOP:
            raise Stopped
        if command == QUIET:
            self.quiet = True
            self._report_at = monotonic()
        elif command.startswith("connect "):
            self._there = command.removeprefix("connect ")

    def _check(self) -> None:
        while not self._commands.empty():
            self._obey(self._commands.get())

    # -- work --------------------------------------------------------------------------------------

    def publish(self, publication: Publication[Any], message: Any) -> None:
        """Publish and count."""
        publication.publish(message)
        self.published += 1

    def serve(self, until: float) -> None:
        """Receive and report until a time (`monotonic`), and at least once.

        Raises:
            Stopped: the parent wants it, or is gone.
        """
        while True:
            self._check()
            now = monotonic()
            if now >= self._looked + LOOK_EVERY:
                self._looked = now
                self.receiver.look()
            if now >= self._report_at:
                self._report()
            self._receive(max(min(until - now, NAP, self._report_at - now), 0.0))
            if monotonic() >= until:
                return

    def _receive(self, timeout: float) -> None:
        for subscription in poll(self.receiver.subscriptions, timeout):
            self.receiver.take(subscription)
            if self._awaited:
                self._awaited = False
                self._report_at = monotonic() + FIRST_REPORT

    def _report(self) -> None:
        now, used = monotonic(), process_time()
        before, used_before = self._used
        self._used = (now, used)
        self._report_at = now + (QUIET_EVERY if self.quiet else REPORT_EVERY)
        link = self._link
        report = Report(
            host=self.plan.host,
            published=self.published,
            rows=self.receiver.rows(link.topic_stats() if link else []),
            peers=link.peers() if link else [],
            link=link.stats() if link else None,
            cpu=(used - used_before) / max(now - before, 1e-6),
            endpoint=self._endpoint,
            attitude=self.attitude(),
            event=_newest_event(link) if link else "",
            quiet=self.quiet,
            done=self.done,
            problem=self.problem,
        )
        with suppress(OSError):  # full: the parent is held up and gets the next one; broken: `_listen` knows
            self._parent.send(msgspec.json.encode(report), socket.MSG_DONTWAIT)

    # -- the end -----------------------------------------------------------------------------------

    def close(self) -> None:
        """Leave network and bus; remove the folder if nobody else will."""
        if self._link is not None:
            self._link.stop()
        self.broker.close()
        self._leave()
        self._ended.set()

    def _leave(self) -> None:
        if not self._orphaned:
            return  # the parent does it
        shutil.rmtree(os.path.join(self.plan.folder, self.plan.host), ignore_errors=True)
        deadline = monotonic() + SIBLING_WAIT
        while monotonic() < deadline and os.path.exists(self.plan.folder):
            with suppress(OSError):
                os.rmdir(self.plan.folder)
                return
            sleep(NAP)
        shutil.rmtree(self.plan.folder, ignore_errors=True)


def run(work: Callable[[Host], None]) -> int:
    """Be the host of the plan in the arguments: `work`, then receive until the parent wants the end."""
    host = Host(msgspec.json.decode(sys.argv[1], type=Plan))
    try:
        work(host)
        while True:
            host.serve(monotonic() + NAP)
    except Stopped:
        return 0
    except (UorbError, ChannelError, OSError, ValueError) as error:
        print(str(error).splitlines()[0], file=sys.stderr)
        return 1
    finally:
        host.close()


def free_port() -> int:
    """Return a TCP port that nobody listens on at this moment."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def _newest_event(link: Link) -> str:
    telling = [event.text for event in link.events() if event.kind != "peer"]
    return telling[-1] if telling else ""
