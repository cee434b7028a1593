"""Shared by all tests: a runtime directory of one's own, brokers of both kinds, scripts in other processes."""

import os
import select
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from time import monotonic, sleep
from typing import IO, cast

import pytest

import uorb_net as uorb

ROOT = Path(__file__).parents[1]
PREAMBLE = """
import os, signal, sys, threading, time
import uorb_net as uorb
from uorb_net import msg
def say(*words): print(*words, flush=True)
def hear(): return sys.stdin.readline().strip()
"""


class Script:
    """A Python script in a process of its own, with a line-wise pipe each way."""

    def __init__(self, code: str, arguments: tuple[str, ...], env: dict[str, str]) -> None:
        self._process = subprocess.Popen(
            [sys.executable, "-c", PREAMBLE + code, *arguments],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env={**os.environ, "PYTHONPATH": str(ROOT), "PYTHONDONTWRITEBYTECODE": "1", **env},
        )
        self._text = b""

    @property
    def pid(self) -> int:
        """The process's pid."""
        return self._process.pid

    def say(self, *words: object) -> None:
        """Send a line."""
        pipe = cast("IO[bytes]", self._process.stdin)
        pipe.write((" ".join(map(str, words)) + "\n").encode())
        pipe.flush()

    def hear(self, seconds: float = 20.0) -> str:
        """Return the next line the script says; a test fails here if none comes in time."""
        pipe = cast("IO[bytes]", self._process.stdout)
        deadline = monotonic() + seconds
        while b"\n" not in self._text:
            if not select.select([pipe], [], [], max(deadline - monotonic(), 0.0))[0]:
                raise AssertionError(f"the script said nothing for {seconds} s")
            data = os.read(pipe.fileno(), 65536)
            if not data:
                raise AssertionError(f"the script ended with status {self._process.wait()}")
            self._text += data
        line, _, self._text = self._text.partition(b"\n")
        return line.decode()

    def ask(self, *words: object) -> str:
        """Send a line and return the answer."""
        self.say(*words)
        return self.hear()

    def signal(self, number: int) -> None:
        """Send a signal."""
        self._process.send_signal(number)

    def stop(self) -> None:
        """Stop it (SIGSTOP), and wait until it is."""
        self.signal(signal.SIGSTOP)
        self.await_stop()

    def await_stop(self, seconds: float = 10.0) -> None:
        """Wait until it is stopped, by itself or by us."""
        assert until(self.stopped, seconds), "the script did not stop"

    def stopped(self) -> bool:
        """Tell whether it is stopped."""
        stat = Path(f"/proc/{self.pid}/stat").read_text()
        return stat.rpartition(")")[2].split()[0] == "T"

    def kill(self) -> None:
        """Kill it as the kernel would (SIGKILL), and wait for its end."""
        self._process.kill()
        self._process.wait(10)

    def ends(self, seconds: float = 20.0) -> int:
        """Return its exit status; minus the signal's number if one ended it."""
        return self._process.wait(seconds)

    def running(self) -> bool:
        """Tell whether it has not ended."""
        return self._process.poll() is None

    def close(self) -> None:
        """Kill it if it still runs, and close the pipes."""
        self.kill()
        for pipe in (self._process.stdin, self._process.stdout):
            try:
                cast("IO[bytes]", pipe).close()
            except BrokenPipeError:
                pass  # it ended with a line of ours unread


def until(condition: Callable[[], object], seconds: float = 5.0) -> bool:
    """Look until `condition` holds, at most `seconds`; tell whether it did."""
    deadline = monotonic() + seconds
    while not condition():
        if monotonic() > deadline:
            return False
        sleep(0.002)
    return True


@pytest.fixture
def eventually() -> Callable[..., bool]:
    """Wait for a condition: `eventually(condition, seconds)`."""
    return until


@pytest.fixture
def free_endpoint() -> Callable[[], str]:
    """Make endpoints on loopback that nobody listens on."""

    def make() -> str:
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            return f"tcp/127.0.0.1:{probe.getsockname()[1]}"

    return make


@pytest.fixture
def runtime_dir(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A fresh folder (mode 0700, in RAM where there is a RAM file system) as $UORB_RUNTIME_DIR."""
    base = "/dev/shm" if os.path.isdir("/dev/shm") else tmp_path
    folder = tempfile.mkdtemp(prefix="uorb-test-", dir=base)
    monkeypatch.setenv("UORB_RUNTIME_DIR", folder)
    monkeypatch.delenv("UORB_VEHICLE", raising=False)
    yield Path(folder)
    shutil.rmtree(folder, ignore_errors=True)


@pytest.fixture
def shared(runtime_dir: Path) -> Iterator[uorb.Broker]:
    """A bus of its own for the test, shared with the scripts it starts."""
    with uorb.Broker() as broker:
        yield broker


@pytest.fixture
def private() -> Iterator[uorb.Broker]:
    """A bus of this process alone."""
    with uorb.Broker.private() as broker:
        yield broker


@pytest.fixture(params=["private", "shared"])
def broker(request: pytest.FixtureRequest) -> uorb.Broker:
    """A bus of each kind."""
    return cast(uorb.Broker, request.getfixturevalue(request.param))


@pytest.fixture
def script(runtime_dir: Path) -> Iterator[Callable[..., Script]]:
    """Start scripts on the test's bus: `script(code, *arguments, **environment)`; killed at its end.

    A script has `uorb`, `msg`, `os`, `sys`, `time`, `signal`, `threading`, `say(*words)` and `hear()`.
    """
    started: list[Script] = []

    def start(code: str, *arguments: object, **env: str) -> Script:
        started.append(Script(code, tuple(map(str, arguments)), env))
        return started[-1]

    yield start
    for one in started:
        one.close()


@pytest.fixture
def in_thread() -> Iterator[Callable[[Callable[[], object]], "Task"]]:
    """Run a function in a thread: `in_thread(function)`; joined at the test's end."""
    tasks: list[Task] = []

    def start(function: Callable[[], object]) -> Task:
        tasks.append(Task(function))
        return tasks[-1]

    yield start
    for task in tasks:
        task.thread.join(10.0)
        assert not task.thread.is_alive(), "a thread of the test hangs"


class Task:
    """A function in a thread, its result or exception kept."""

    def __init__(self, function: Callable[[], object]) -> None:
        self._function = function
        self._result: object = None
        self._error: BaseException | None = None
        self.thread = threading.Thread(target=self._run, daemon=True)
        self.thread.start()

    def _run(self) -> None:
        try:
            self._result = self._function()
        except BaseException as error:
            self._error = error

    def done(self) -> bool:
        """Tell whether it has ended."""
        return not self.thread.is_alive()

    def result(self, seconds: float = 10.0) -> object:
        """Return its result, or raise what it raised."""
        self.thread.join(seconds)
        assert not self.thread.is_alive(), f"the thread did not end within {seconds} s"
        if self._error is not None:
            raise self._error
        return self._result
