"""One link per bus and kind of channel: a lock in the bus's folder that dies with its process."""

import fcntl
import os

from ..broker.directory import Directory
from ..errors import LinkError


class Hold:
    """The right to be the bus's link of one kind."""

    def __init__(self, directory: Directory, kind: str) -> None:
        """Take it.

        Raises:
            LinkError: another link of the kind has it; the error names its process.
        """
        self._key = (directory.path if not directory.single else id(directory), kind)
        self._fd = -1
        if self._key in _held:
            raise LinkError(_taken(kind, os.getpid()))
        if not directory.single:
            self._fd = self._lock(os.path.join(directory.path, f".link-{kind}"), kind)
        _held.add(self._key)

    @staticmethod
    def _lock(path: str, kind: str) -> int:
        fd = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
        try:
            fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            holder = os.pread(fd, 32, 0).decode("ascii", "replace").strip()
            os.close(fd)
            raise LinkError(_taken(kind, holder or "unknown")) from None
        os.pwrite(fd, f"{os.getpid():<31}\n".encode(), 0)
        return fd

    def release(self) -> None:
        """Give it up."""
        _held.discard(self._key)
        if self._fd >= 0:
            os.close(self._fd)
            self._fd = -1


def _taken(kind: str, pid: object) -> str:
    return f"this bus has a {kind} link already, in process {pid}: stop it first, or use its link"


_held: set[tuple[object, str]] = set()
