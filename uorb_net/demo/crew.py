"""The demo's two processes as their parent sees them: started, listened to, ended, cleaned up after."""

import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from selectors import EVENT_READ, DefaultSelector
from time import monotonic
from typing import IO

import msgspec

from ..errors import UorbError
from .reports import AUTOPILOT, COMPANION, STOP, Plan, Report

END_WAIT = 1.3  # seconds for the processes to leave in order; then they are killed
REPORT_SIZE = 1 << 20  # bytes of the largest report
ROOT = Path(__file__).parents[2]  # where the processes find this package, installed or not


class HostDied(UorbError):  # noqa: N818 - what happened, not what went wrong here
    """One of the processes ended by itself; the text says which and why."""


class Process:
    """One host's process and the parent's end of its socket pair."""

    def __init__(self, host: str, folder: str, *, seed: int, log: str) -> None:
        self.host = host
        self.socket, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self.socket.setblocking(False)
        self._errors: IO[bytes] = tempfile.TemporaryFile(dir=folder)  # noqa: SIM115 - closed by `end`
        plan = Plan(host, theirs.fileno(), folder, seed, log)
        with theirs:
            theirs.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, REPORT_SIZE)
            self._process = subprocess.Popen(
                [sys.executable, "-P", "-m", f"{__package__}.{host}", msgspec.json.encode(plan).decode()],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=self._errors,
                pass_fds=(plan.socket,),
                env=_environment(os.path.join(folder, host)),
                start_new_session=True,  # Ctrl-C is for the parent, which then ends this
            )

    def say(self, command: str) -> None:
        """Send a command; one that is gone does not hear it."""
        with suppress(OSError):
            self.socket.send(command.encode())

    def report(self) -> Report | None:
        """Return the next report; None if there is none.

        Raises:
            HostDied: the process is gone.
        """
        try:
            data = self.socket.recv(REPORT_SIZE)
        except BlockingIOError:
            return None
        except OSError:
            data = b""
        if not data:
            raise HostDied(self._epitaph())
        return msgspec.json.decode(data, type=Report)

    def _epitaph(self) -> str:
        try:
            status = self._process.wait(END_WAIT)
        except subprocess.TimeoutExpired:
            return f"{self.host} closed its end and does not end"
        if status < 0:
            return f"{self.host} was killed: {signal.Signals(-status).name}"
        self._errors.seek(0)
        lines = self._errors.read().decode("utf-8", "replace").strip().splitlines()
        return f"{self.host}: {lines[-1]}" if lines else f"{self.host} ended with status {status}"

    def wait(self, deadline: float) -> None:
        """Wait for the end, and make it one at the deadline."""
        try:
            self._process.wait(max(deadline - monotonic(), 0.0))
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self.socket.close()
        self._errors.close()


def _environment(runtime: str) -> dict[str, str]:
    environment = {name: value for name, value in os.environ.items() if name not in _FOREIGN}
    path = [str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])]
    return environment | {"UORB_RUNTIME_DIR": runtime, "PYTHONPATH": os.pathsep.join(path)}


# The demo's messages are the shipped ones, its hosts have names of their own.
_FOREIGN = {"UORB_MSG_PATH", "UORB_HOST"}


class Crew:
    """Both processes and their folder.

    Attributes:
        folder: holds each host's runtime directory.
        reports: the newest of each host.
    """

    def __init__(self, *, seed: int, log: str) -> None:
        self.reports: dict[str, Report] = {}
        self.processes: list[Process] = []
        ram = "/dev/shm"
        self.folder = tempfile.mkdtemp(prefix="uorb-demo-", dir=ram if os.path.isdir(ram) else None)
        self._selector = DefaultSelector()
        self._endpoint = ""
        try:
            for host in (AUTOPILOT, COMPANION):
                process = Process(host, self.folder, seed=seed, log=log)
                self.processes.append(process)
                self._selector.register(process.socket, EVENT_READ, process)
        except BaseException:
            self.end()
            raise

    def say(self, command: str) -> None:
        """Send both a command."""
        for process in self.processes:
            process.say(command)

    def listen(self, timeout: float) -> Iterator[Report]:
        """Yield the reports that come within `timeout` seconds, at least those that are there.

        Raises:
            HostDied: a process is gone.
        """
        for key, _ in self._selector.select(max(timeout, 0.0)):
            process: Process = key.data
            while (report := process.report()) is not None:
                self.reports[report.host] = report
                self._introduce(report)
                yield report

    def _introduce(self, report: Report) -> None:
        """Tell the companion where the autopilot listens."""
        if report.endpoint and not self._endpoint:
            self._endpoint = report.endpoint
            self.say(f"connect {report.endpoint}")

    def end(self) -> None:
        """End both processes and remove their folder."""
        self.say(STOP)
        deadline = monotonic() + END_WAIT
        for process in self.processes:
            process.wait(deadline)
        self._selector.close()
        shutil.rmtree(self.folder, ignore_errors=True)
