"""Where the publisher is: in this process, in another process, on another host over Zenoh. One suite for all."""

import json
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from tempfile import mkdtemp
from time import monotonic, sleep
from typing import Any

import pytest

import uorb_net as uorb
from communicator import ZenohChannel
from uorb_net import messages

ROOT = Path(__file__).parents[2]


class Publisher:
    """A publication, wherever it is."""

    def __init__(self, place: "Place", index: int, instance: int) -> None:
        self._place = place
        self._index = index
        self.instance = instance

    def publish(self, *rows: dict[str, Any]) -> None:
        """Publish messages, given by their fields."""
        self._place.ask("publish", self._index, rows)

    def unadvertise(self) -> None:
        """Stop publishing."""
        self._place.ask("unadvertise", self._index)


class Place:
    """The subscriber's broker here, and publishers somewhere."""

    remote = False

    def __init__(self, broker: uorb.Broker) -> None:
        self.broker = broker

    def advertise(self, topic: str, *, multi: bool = False, **options: Any) -> Publisher:
        """Advertise there, and wait until it is known here."""
        before = self.broker.group_count(topic) if topic in messages.topics() else 0
        index, instance = self.ask("advertise", topic, multi, options)
        if multi or not before:
            assert self.eventually(lambda: self.broker.group_count(topic) > before)
        if any(s.topic == topic and s.instance == instance and s.subscribers for s in self.broker.topics()):
            assert self.eventually(lambda: self.wanted(index)), "the subscription did not reach the publisher's host"
        return Publisher(self, index, instance)

    def wanted(self, index: int) -> bool:
        """Tell whether the subscription here is known where the publisher is."""
        return True

    def ask(self, *command: Any) -> Any:
        """Carry a command out there."""
        raise NotImplementedError

    def lost(self) -> int:
        """Return what was lost on the way here: nothing, unless there is a network."""
        return 0

    def eventually(self, condition: Callable[[], object], seconds: float = 5.0) -> bool:
        """Tell whether a condition holds: at once on one host, soon over a network."""
        deadline = monotonic() + (seconds if self.remote else 0.0)
        while not condition():
            if monotonic() >= deadline:
                return False
            sleep(0.002)
        return True

    def kill(self) -> None:
        """Kill the publishing process."""
        raise NotImplementedError

    def close(self) -> None:
        """End everything."""
        self.broker.close()


class Here(Place):
    """Publishers in this process."""

    def __init__(self, broker: uorb.Broker) -> None:
        super().__init__(broker)
        self._publications: list[uorb.Publication[Any]] = []

    def ask(self, *command: Any) -> Any:
        what, *arguments = command
        if what == "advertise":
            topic, multi, options = arguments
            make = self.broker.advertise_multi if multi else self.broker.advertise
            self._publications.append(make(topic, **options))
            return len(self._publications) - 1, self._publications[-1].instance
        publication = self._publications[arguments[0]]
        if what == "publish":
            for fields in arguments[1]:
                publication.publish(messages.type_for_topic(publication.topic)(**fields))
            return None
        return publication.unadvertise()


class Elsewhere(Place):
    """Publishers in another process, of this host or of another."""

    def __init__(self, broker: uorb.Broker, env: dict[str, str], *arguments: str) -> None:
        super().__init__(broker)
        command = [sys.executable, str(Path(__file__).parent / "publisher.py"), *arguments]
        pipes: dict[str, Any] = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
        self.process = subprocess.Popen(command, text=True, env={**os.environ, **env, "PYTHONPATH": str(ROOT)}, **pipes)
        assert self._answer() == "ready"

    def ask(self, *command: Any) -> Any:
        assert self.process.stdin is not None
        self.process.stdin.write(json.dumps(command) + "\n")
        self.process.stdin.flush()
        return self._answer()

    def _answer(self) -> Any:
        assert self.process.stdout is not None
        return json.loads(self.process.stdout.readline())

    def kill(self) -> None:
        self.process.send_signal(signal.SIGKILL)
        self.process.wait(10)

    def close(self) -> None:
        self.process.kill()
        self.process.communicate()
        super().close()


class OtherHost(Elsewhere):
    """Publishers on another host: its own bus, joined to this one by a link over TCP."""

    remote = True

    def __init__(self, broker: uorb.Broker, far: str, endpoint: str) -> None:
        self.link = uorb.Link(broker, ZenohChannel(listen=[endpoint]), host="near").start()
        super().__init__(broker, {"UORB_RUNTIME_DIR": far}, endpoint)
        assert self.link.wait_for_peer("far", 10.0)

    def wanted(self, index: int) -> bool:
        return bool(self.ask("wanted", index))

    def lost(self) -> int:
        return self.link.stats().lost


@pytest.fixture
def folder() -> Iterator[Callable[[], str]]:
    """Make runtime directories on a RAM file system, removed after."""
    made: list[str] = []

    def make() -> str:
        made.append(mkdtemp(prefix="uorb-places-", dir="/dev/shm" if os.path.isdir("/dev/shm") else None))
        return made[-1]

    yield make
    for path in made:
        shutil.rmtree(path, ignore_errors=True)


@pytest.fixture(params=["private", "thread", "process", "host"])
def place(
    request: pytest.FixtureRequest,
    folder: Callable[[], str],
    free_endpoint: Callable[[], str],
    monkeypatch: pytest.MonkeyPatch,
) -> Iterator[Place]:
    """A bus with its publishers in one of the places."""
    near = folder()
    monkeypatch.setenv("UORB_RUNTIME_DIR", near)
    broker = uorb.Broker.private() if request.param == "private" else uorb.Broker()
    made: Place
    if request.param in ("private", "thread"):
        made = Here(broker)
    elif request.param == "process":
        made = Elsewhere(broker, {"UORB_RUNTIME_DIR": near})
    else:
        made = OtherHost(broker, folder(), free_endpoint())
    yield made
    made.close()
