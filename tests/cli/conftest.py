"""The real command in processes of its own, on a bus of each test's own."""

import io
import os
import shutil
import socket
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from time import monotonic, sleep

import pytest

import uorb_net as uorb
from uorb_net.cli import main

COMMAND = (sys.executable, "-m", "uorb_net.cli")


def until(condition: Callable[[], object], seconds: float = 10.0) -> bool:
    """Wait until a condition holds, at most so long."""
    deadline = monotonic() + seconds
    while not condition():
        if monotonic() > deadline:
            return False
        sleep(0.005)
    return True


class Shell:
    """A bus's folder: runs the command on it, and opens it for the test itself."""

    def __init__(self) -> None:
        self.folder = tempfile.mkdtemp(dir="/dev/shm" if os.path.isdir("/dev/shm") else None)  # mode 0700
        self.until = until
        self._processes: list[subprocess.Popen[str]] = []
        self._brokers: list[uorb.Broker] = []

    def environment(self, **changes: str) -> dict[str, str]:
        """Return the environment of a command on this bus."""
        own = {k: v for k, v in os.environ.items() if not k.startswith("UORB_")}
        return own | {"UORB_RUNTIME_DIR": self.folder, "PYTHONDONTWRITEBYTECODE": "1"} | changes

    def run(self, *arguments: str, **changes: str) -> subprocess.CompletedProcess[str]:
        """Run the command to its end."""
        environment = self.environment(**changes)
        return subprocess.run(
            [*COMMAND, *arguments], env=environment, capture_output=True, text=True, timeout=30, check=False
        )

    def run_here(self, *arguments: str) -> tuple[int, str, str]:
        """Run the command in this process: status, output, errors. For what ends before it waits."""
        output, errors = io.StringIO(), io.StringIO()
        with pytest.MonkeyPatch.context() as patch:
            patch.setenv("UORB_RUNTIME_DIR", self.folder)
            with redirect_stdout(output), redirect_stderr(errors):
                status = main(arguments)
        return status, output.getvalue(), errors.getvalue()

    def spawn(
        self, *arguments: str, stdin: int | None = None, stdout: int = subprocess.PIPE, **changes: str
    ) -> subprocess.Popen[str]:
        """Start the command; it is killed at the test's end at the latest."""
        process = subprocess.Popen(
            [*COMMAND, *arguments],
            env=self.environment(**changes),
            stdin=stdin,
            stdout=stdout,
            stderr=subprocess.PIPE,
            text=True,
        )
        self._processes.append(process)
        return process

    def broker(self) -> uorb.Broker:
        """Open the bus in the test's process."""
        with pytest.MonkeyPatch.context() as patch:
            patch.setenv("UORB_RUNTIME_DIR", self.folder)
            patch.delenv("UORB_VEHICLE", raising=False)
            broker = uorb.Broker()
        self._brokers.append(broker)
        return broker

    def close(self) -> None:
        """End what still runs and remove the bus."""
        for process in self._processes:
            process.kill()
            process.wait()
            for stream in (process.stdin, process.stdout, process.stderr):
                if stream is not None:
                    stream.close()
        for broker in self._brokers:
            broker.close()
        shutil.rmtree(self.folder, ignore_errors=True)


@pytest.fixture
def shell() -> Iterator[Shell]:
    """A host."""
    shell = Shell()
    yield shell
    shell.close()


@pytest.fixture
def far() -> Iterator[Shell]:
    """Another host."""
    shell = Shell()
    yield shell
    shell.close()


@pytest.fixture
def endpoint() -> str:
    """An endpoint on a TCP port nobody listens on."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


@pytest.fixture
def strange_definitions(tmp_path: Path) -> str:
    """A directory with a definition that nobody else has, and another one of a shipped topic."""
    folder = tmp_path / "msg"
    folder.mkdir()
    (folder / "StrangeThing.msg").write_text(
        "uint64 timestamp\nuint8 MAX = 3\nfloat32[2] pair\nchar[8] label\nStrangePart part\n"
        "StrangePart[2] parts\nbool on\n"
    )
    (folder / "StrangePart.msg").write_text("float64 wide\nuint8[3] raw\n")
    (folder / "VehicleAttitude.msg").write_text("uint64 timestamp\nfloat64[4] q\nint16 extra\n")
    return str(folder)
