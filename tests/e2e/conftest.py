"""A vehicle of two hosts as an operator starts it: two runtime directories, two link processes, Zenoh over TCP."""

import json
import os
import shutil
import signal
import struct
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from tempfile import mkdtemp
from time import monotonic, sleep
from typing import Any

import pytest

ROOT = Path(__file__).parents[2]


class Host:
    """One host: a runtime directory, its link process, and what else runs on it."""

    def __init__(self, name: str, endpoint: list[str], scratch: Path) -> None:
        self.name = name
        self.endpoint = endpoint
        self.scratch = scratch
        base = "/dev/shm" if os.path.isdir("/dev/shm") else None
        self.folder = mkdtemp(prefix="uorb-e2e-", dir=base)
        self.env = {**os.environ, "UORB_RUNTIME_DIR": self.folder, "PYTHONPATH": str(ROOT)}
        self.log = scratch / f"{name}.log"
        self.link: subprocess.Popen[str] | None = None
        self.others: list[subprocess.Popen[str]] = []

    def start(self) -> None:
        """Start the link process."""
        with self.log.open("a") as log:
            command = [sys.executable, "-m", "uorb_net.cli", "start", "--host", self.name, *self.endpoint]
            self.link = subprocess.Popen(command, env=self.env, stderr=log, stdout=log, text=True)

    def kill(self) -> None:
        """Kill the link process as a power cut would."""
        assert self.link is not None
        self.link.send_signal(signal.SIGKILL)
        self.link.wait(10)

    def uorb(self, *arguments: str) -> "subprocess.Popen[str]":
        """Run a verb on this host."""
        return self.run([sys.executable, "-m", "uorb_net.cli", *arguments])

    def reader(self, *topics: str) -> "Reader":
        """Start a subscriber process."""
        out = self.scratch / f"{self.name}-{len(self.others)}.json"
        script = str(Path(__file__).parent / "reader.py")
        return Reader(self.run([sys.executable, script, str(out), *topics]), out)

    def run(self, command: list[str]) -> "subprocess.Popen[str]":
        """Run a process on this host."""
        pipes: dict[str, Any] = {
            "stdin": subprocess.PIPE,
            "stdout": subprocess.PIPE,
            "stderr": subprocess.PIPE,
        }
        process = subprocess.Popen(command, env=self.env, text=True, **pipes)
        self.others.append(process)
        return process

    def says(self, text: str, seconds: float, times: int = 1) -> bool:
        """Wait until the link has logged `text`, so often."""
        deadline = monotonic() + seconds
        while self.log.read_text().count(text) < times:
            if monotonic() > deadline:
                return False
            sleep(0.01)
        return True

    def folder_has(self, node: str) -> bool:
        """Tell whether the bus of this host has a node."""
        return os.path.exists(os.path.join(self.folder, "default", node))

    def close(self) -> None:
        """End everything of this host."""
        for process in [*self.others, *([self.link] if self.link else [])]:
            if process.poll() is None:
                process.kill()
            process.communicate()
        shutil.rmtree(self.folder, ignore_errors=True)


class Reader:
    """A subscriber process and what it got."""

    def __init__(self, process: "subprocess.Popen[str]", out: Path) -> None:
        self.process = process
        self.out = out
        assert process.stdout is not None
        assert process.stdout.readline().strip() == "ready", process.communicate()

    def rows(self) -> tuple[dict[str, list[Any]], dict[str, int]]:
        """End it; return the messages by topic, and what each subscription lost."""
        _, errors = self.process.communicate("stop\n", timeout=30)
        assert self.process.returncode == 0, errors
        result = json.loads(self.out.read_text())
        return result["rows"], result["lost"]


@pytest.fixture
def hosts(tmp_path: Path, free_endpoint: Callable[[], str]) -> Iterator[tuple[Host, Host]]:
    """An autopilot that listens and a companion that connects, both started."""
    endpoint = free_endpoint()
    pair = (
        Host("autopilot", ["--listen", endpoint], tmp_path),
        Host("companion", ["--connect", endpoint], tmp_path),
    )
    for host in pair:
        host.start()
    try:
        assert pair[0].says("peer: companion is up", 15.0), pair[0].log.read_text()
        assert pair[1].says("peer: autopilot is up", 15.0), pair[1].log.read_text()
        yield pair
    finally:
        for host in pair:
            host.close()


def small_log(path: Path, seconds: float, rate: int) -> list[int]:
    """Write a ULog of one topic, `sensor_combined` with a counter, and return its timestamps in µs."""

    def message(kind: bytes, body: bytes) -> bytes:
        return struct.pack("<Hc", len(body), kind) + body

    stamps = [1_000_000 + round(n * 1e6 / rate) for n in range(round(seconds * rate))]
    parts = [b"ULog\x01\x12\x35\x01" + struct.pack("<Q", 1_000_000), message(b"B", bytes(40))]
    parts.append(message(b"F", b"sensor_combined:uint64_t timestamp;uint32_t count;float[3] gyro_rad;"))
    parts.append(message(b"A", b"\0\0\0sensor_combined"))
    for count, stamp in enumerate(stamps):
        parts.append(message(b"D", struct.pack("<HQI3f", 0, stamp, count, 0.5, -0.25, count)))
    path.write_bytes(b"".join(parts))
    return stamps


@pytest.fixture
def make_log() -> Callable[[Path, float, int], list[int]]:
    """Write a small log: path, seconds, samples per second."""
    return small_log
