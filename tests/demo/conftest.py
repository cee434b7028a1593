"""Runs `uorb demo` as a user does, and finds what it leaves behind."""

import os
import re
import select
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from time import monotonic

import pytest

ROOT = Path(__file__).parents[2]


class Running:
    """The command in a process of its own, its output in a pipe."""

    def __init__(self, *arguments: str) -> None:
        environment = {name: value for name, value in os.environ.items() if not name.startswith("UORB_")}
        self.begun = monotonic()
        self.process = subprocess.Popen(
            [sys.executable, "-m", "uorb_net.cli", "demo", *arguments],
            cwd=ROOT,
            env=environment | {"PYTHONDONTWRITEBYTECODE": "1"},
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
        )
        self.output = ""

    def read_until(self, text: str, seconds: float = 15.0) -> str:
        """Read until a text has come, or the end; return all output so far."""
        assert self.process.stdout is not None
        deadline = monotonic() + seconds
        while text not in self.output:
            left = deadline - monotonic()
            assert left > 0, f"no {text!r} within {seconds} s of:\n{self.output}"
            if select.select([self.process.stdout], [], [], left)[0]:
                data = os.read(self.process.stdout.fileno(), 1 << 16)
                if not data:
                    break
                self.output += data.decode()
        return self.output

    @property
    def folder(self) -> Path:
        """The demo's folder, as its screen tells."""
        self.read_until(" uorb top\n")
        found = re.search(r"UORB_RUNTIME_DIR=(\S+)/companion ", self.output)
        assert found is not None
        return Path(found[1])

    def hosts(self) -> list[int]:
        """Return descriptors of the two hosts' processes."""
        mark = str(self.folder).encode()
        pids = [int(p.name) for p in Path("/proc").iterdir() if p.name.isdigit() and mark in _arguments(p)]
        assert len(pids) == 2
        return [os.pidfd_open(pid) for pid in pids]

    def end(self, seconds: float = 15.0) -> tuple[int, str, str]:
        """Wait for the end: status, all output, errors."""
        output, errors = self.process.communicate(timeout=seconds)
        return self.process.returncode, self.output + (output or b"").decode(), errors.decode()

    def close_output(self) -> None:
        """Read no more."""
        assert self.process.stdout is not None
        self.process.stdout.close()
        self.process.stdout = None

    def kill(self) -> None:
        """End it, however it is doing."""
        if self.process.poll() is None:
            self.process.kill()
        self.process.communicate()


def _arguments(process: Path) -> bytes:
    try:
        return (process / "cmdline").read_bytes()
    except OSError:
        return b""


@pytest.fixture
def demo() -> Iterator[Callable[..., Running]]:
    """Start the command; what still runs at the end of the test is killed."""
    started: list[Running] = []

    def start(*arguments: str) -> Running:
        started.append(Running(*arguments))
        return started[-1]

    yield start
    for running in started:
        running.kill()


@pytest.fixture
def all_gone() -> Callable[[list[int]], bool]:
    """Wait until the processes behind descriptors have ended, at most 6 s."""

    def wait(processes: list[int]) -> bool:
        deadline = monotonic() + 6.0
        gone = [bool(select.select([p], [], [], max(deadline - monotonic(), 0.0))[0]) for p in processes]
        for process in processes:
            os.close(process)
        return all(gone)

    return wait


@pytest.fixture
def kill_one() -> Callable[[list[int]], None]:
    """Kill the first of some processes, and forget the others."""

    def kill(processes: list[int]) -> None:
        signal.pidfd_send_signal(processes[0], signal.SIGKILL)
        for process in processes:
            os.close(process)

    return kill
