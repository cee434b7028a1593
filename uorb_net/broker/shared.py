"""A vehicle's folder on a RAM file system: nodes as files, locks that die with their process.

Names that start with a dot are ours, all others are nodes: `ls` shows what `ls /obj` shows on NuttX.
docs/node.md says what each file is for.
"""

import errno
import fcntl
import mmap
import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from struct import pack, unpack
from tempfile import gettempdir
from threading import RLock
from time import monotonic, sleep

from ..errors import BusError, ClosedError
from .descriptors import more_descriptors
from .directory import B_END, B_HOLDER, B_PROCESS, BUS_SIZE, LOCK_WAIT, Directory, Filler
from .layout import MAGIC, W_MAGIC, Label, Shape, format_node, node_name
from .mapping import Mapping
from .waking import End

ALIVE_BASE = 1 << 32  # liveness locks start here; below it lie the pids
F_OFD_GETLK, F_OFD_SETLK = 36, 37
MAP_FLAGS = mmap.MAP_SHARED | getattr(mmap, "MAP_POPULATE", 0)
KEPT_ENDS = 256  # descriptors kept for other processes' sleepers before the dead ones are looked for


def runtime_dir() -> str:
    """Return the folder of all buses: $UORB_RUNTIME_DIR, else one of this user on a RAM file system."""
    given = os.environ.get("UORB_RUNTIME_DIR")
    if given:
        return given
    base = "/dev/shm" if os.path.isdir("/dev/shm") else gettempdir()
    return os.path.join(base, f"uorb-{os.getuid()}")


def checked_folder(path: str, forbidden: int) -> None:
    """Make `path` with mode 0700, or refuse what is there: not ours, a link, or open to others.

    Raises:
        BusError: with the reason and the way out.
    """
    try:
        os.makedirs(path, 0o700, exist_ok=True)
        found = os.lstat(path)
    except OSError as error:
        raise BusError(error.errno or errno.EIO, f"{path}: {error.strerror}: set UORB_RUNTIME_DIR") from error
    if not stat.S_ISDIR(found.st_mode):
        raise BusError(errno.ENOTDIR, f"{path} is a link or a file, not a folder of this user: remove it")
    if found.st_uid != os.getuid():
        raise BusError(errno.EPERM, f"{path} belongs to user {found.st_uid}: set UORB_RUNTIME_DIR to a folder of yours")
    if found.st_mode & forbidden:
        mode = stat.S_IMODE(found.st_mode)
        raise BusError(errno.EPERM, f"{path} is open to others (mode {mode:04o}): chmod 700 it, or remove it")


class SharedDirectory(Directory):
    """The folder `runtime/vehicle`; one object per process and folder."""

    def __init__(self, runtime: str, vehicle: str) -> None:
        super().__init__()
        self.path = os.path.join(runtime, vehicle)
        checked_folder(runtime, 0o022)
        checked_folder(self.path, 0o077)
        self._threads = RLock()
        self._depth = 0
        self._lock_fd = self._alive_fd = -1
        self.me = 0
        try:
            self._lock_fd = more_descriptors(lambda: self._open(".lock"))
            self._alive_fd = more_descriptors(lambda: self._open(".alive"))
            with self.hold():
                self._settle()
        except BaseException:
            self._close_descriptors()
            raise

    # -- the directory lock ------------------------------------------------------------------------

    @contextmanager
    def hold(self, wait: float = LOCK_WAIT) -> Iterator[None]:
        if self.closed:
            raise ClosedError(f"the bus {self.path} was closed, or this is a forked child: make a new Broker")
        if not self._threads.acquire(timeout=max(wait, 0.0)):
            raise BusError(errno.EAGAIN, f"{self.path}: a thread of this process holds the directory lock")
        try:
            if self.closed:  # while this thread waited for its turn
                raise ClosedError(f"the bus {self.path} was closed: make a new Broker")
            if not self._depth:
                self._flock(wait)
            self._depth += 1
            try:
                yield
            finally:
                self._depth -= 1
                if not self._depth and self._lock_fd >= 0:
                    fcntl.flock(self._lock_fd, fcntl.LOCK_UN)
        finally:
            self._threads.release()

    def _flock(self, wait: float) -> None:
        deadline = monotonic() + wait
        pause = 0.00005
        while True:
            try:
                fcntl.flock(self._lock_fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
                break
            except BlockingIOError:
                if monotonic() >= deadline:
                    raise BusError(errno.EAGAIN, self._holder(wait)) from None
                sleep(pause)
                pause = min(pause * 2, 0.002)
        if not os.fstat(self._lock_fd).st_nlink:
            fcntl.flock(self._lock_fd, fcntl.LOCK_UN)
            raise BusError(errno.ESTALE, self._removed())
        if self.me:
            self.bulletin[B_HOLDER] = self.me

    def _removed(self) -> str:
        return f"{self.path} was removed under running processes: restart them all"

    def _holder(self, wait: float) -> str:
        with open(os.path.join(self.path, ".bus"), "rb") as file:  # this process may not have joined yet
            holder = int.from_bytes(file.read(8 * B_HOLDER + 8)[8 * B_HOLDER :], "little")
        who = f"process {self.pid(holder)}" if holder else "another process"
        return f"{self.path}: {who} has held the directory lock for {wait:.0f} s; is it stopped? (kill -CONT)"

    # -- joining -----------------------------------------------------------------------------------

    def _settle(self) -> None:
        """Open the folder's .bus, made or made anew where nobody lives; take a process number."""
        lonely = not self._anybody()
        words = self._bus(more_descriptors(lambda: self._open(".bus")))
        foreign = words[W_MAGIC] != MAGIC
        if foreign and not lonely:
            raise BusError(errno.EPROTO, self._foreign(words[W_MAGIC]))
        if lonely:
            words[W_MAGIC] = 0
            self._empty()
            for index in range(1 if foreign else B_HOLDER + 1, len(words)):  # numbers are never reused, so they stay
                words[index] = 0
        words[W_MAGIC] = MAGIC
        words[B_PROCESS] += 1
        self.bulletin = words
        self.me = words[B_PROCESS]
        self._ofd(F_OFD_SETLK, fcntl.F_WRLCK, ALIVE_BASE + self.me, 1)
        with suppress(OSError):  # file system full: only messages miss it
            os.pwrite(self._alive_fd, pack("<Q", os.getpid()), 8 * self.me)
        self.sweep()

    def _bus(self, fd: int) -> "memoryview[int]":
        try:
            if os.fstat(fd).st_size < BUS_SIZE:
                self._allocate(fd, BUS_SIZE, ".bus")
            words = memoryview(more_descriptors(lambda: mmap.mmap(fd, BUS_SIZE, flags=MAP_FLAGS))).cast("Q")
        finally:
            os.close(fd)
        return words

    def _foreign(self, magic: int) -> str:
        pid = next((self.pid(n) for n in range(1, 1 << 16) if self._locked(ALIVE_BASE + n, 1)), 0)
        return (
            f"{self.path} is in use by process {pid} with layout {magic & 0xFFFFFFFF}, this is layout "
            f"{MAGIC & 0xFFFFFFFF}: end the processes of the other version, or set UORB_RUNTIME_DIR"
        )

    def _empty(self) -> None:
        """Remove all but the lock files of a bus on which nobody lives."""
        for name in self._listed():
            if name not in (".lock", ".alive", ".bus"):
                self._unlink(name)

    def sweep(self) -> None:
        for name in self._listed():
            if name.endswith(".new") or (name.startswith(".w") and self._orphan(name)):
                self._unlink(name)

    def _orphan(self, name: str) -> bool:
        try:
            os.close(os.open(os.path.join(self.path, name), os.O_WRONLY | os.O_NONBLOCK | os.O_CLOEXEC))
        except OSError as error:
            return error.errno == errno.ENXIO
        return False

    # -- who lives ---------------------------------------------------------------------------------

    def alive(self, process: int) -> bool:
        return process == self.me or self._locked(ALIVE_BASE + process, 1)

    def pid(self, process: int) -> int:
        raw = os.pread(self._alive_fd, 8, 8 * process)
        return int.from_bytes(raw, "little")

    def _anybody(self) -> bool:
        return self._locked(ALIVE_BASE, 0)

    def _locked(self, start: int, length: int) -> bool:
        return self._ofd(F_OFD_GETLK, fcntl.F_WRLCK, start, length) != fcntl.F_UNLCK

    def _ofd(self, command: int, kind: int, start: int, length: int) -> int:
        """Run an open-file-description lock call; struct flock of 64-bit Linux, fcntl(2)."""
        answer = fcntl.fcntl(self._alive_fd, command, pack("hhqqi4x", kind, os.SEEK_SET, start, length, 0))
        return int(unpack("hhqqi4x", answer)[0])

    # -- nodes -------------------------------------------------------------------------------------

    def find(self, topic: str, instance: int, populate: bool = True) -> Mapping | None:
        name = node_name(topic, instance)
        try:
            fd = more_descriptors(lambda: self._open(name, 0))
        except FileNotFoundError:
            return None
        try:
            found = os.fstat(fd)
            if found.st_size < BUS_SIZE:
                raise BusError(errno.EPROTO, f"{self.path}/{name} is no node: remove it")
            flags = MAP_FLAGS if populate else mmap.MAP_SHARED
            buffer = more_descriptors(lambda: mmap.mmap(fd, found.st_size, flags=flags))
        finally:
            os.close(fd)
        mapping = Mapping(buffer, found.st_ino)
        if mapping.words[W_MAGIC] != MAGIC or mapping.base + mapping.slots * mapping.stride > found.st_size:
            raise BusError(errno.EPROTO, f"{self.path}/{name} is no node of this layout: remove it")
        return mapping

    def install(self, label: Label, shape: Shape, fill: Filler | None = None) -> Mapping:
        name = node_name(label.topic, label.instance)
        building = f".{name}.new"
        fd = more_descriptors(lambda: self._open(building, os.O_CREAT | os.O_TRUNC))  # a kill may have left one
        try:
            self._allocate(fd, shape.size, building)
            buffer = more_descriptors(lambda: mmap.mmap(fd, shape.size, flags=MAP_FLAGS))
            identity = os.fstat(fd).st_ino
        except BaseException:
            self._unlink(building)
            raise
        finally:
            os.close(fd)
        format_node(buffer, label, shape)
        mapping = Mapping(buffer, identity)
        if fill is not None:
            fill(mapping)
        os.rename(os.path.join(self.path, building), os.path.join(self.path, name))
        return mapping

    def names(self) -> list[tuple[str, int]]:
        found = []
        for name in self._listed():
            topic, _, instance = name.partition(".")
            if topic and (not instance or instance.isdecimal()):
                found.append((topic, int(instance or 0)))
        return sorted(found)

    def lock_file(self, topic: str, instance: int, mapping: Mapping) -> int | None:
        try:
            fd = more_descriptors(lambda: self._open(node_name(topic, instance), 0))
        except FileNotFoundError:
            raise BusError(errno.ESTALE, self._removed()) from None
        if os.fstat(fd).st_ino != mapping.identity:
            os.close(fd)
            return None
        return fd

    def _open(self, name: str, create: int = os.O_CREAT) -> int:
        try:
            return os.open(os.path.join(self.path, name), os.O_RDWR | os.O_CLOEXEC | create, 0o600)
        except FileNotFoundError:
            if not create:
                raise
            raise BusError(errno.ENOENT, f"{self.path} is gone: restart the processes of this bus") from None
        except OSError as error:
            if error.errno == errno.EMFILE:
                raise
            raise BusError(error.errno or errno.EIO, f"{self.path}/{name}: {error.strerror}") from error

    def _allocate(self, fd: int, size: int, name: str) -> None:
        """Reserve all pages now: a page that a full file system cannot give later would be SIGBUS."""
        try:
            os.posix_fallocate(fd, 0, size)
        except OSError as error:
            free = os.statvfs(self.path)
            raise BusError(
                error.errno or errno.ENOSPC,
                f"{self.path}/{name} needs {size} bytes, the file system has {free.f_bavail * free.f_frsize}:"
                f" {error.strerror}; give it more room, use a shorter queue, or set UORB_RUNTIME_DIR",
            ) from error

    def _listed(self) -> list[str]:
        return more_descriptors(lambda: os.listdir(self.path))

    def _unlink(self, name: str) -> None:
        try:
            os.unlink(os.path.join(self.path, name))
        except FileNotFoundError:
            return  # another process was faster

    # -- sleepers' ends ----------------------------------------------------------------------------

    def new_end(self) -> End:
        with self.hold():
            self.bulletin[B_END] += 1
            number = self.bulletin[B_END]
            path = os.path.join(self.path, f".w{number}")
            try:
                os.mkfifo(path, 0o600)
                fd = more_descriptors(lambda: os.open(path, os.O_RDWR | os.O_NONBLOCK | os.O_CLOEXEC))
            except OSError as error:
                raise BusError(error.errno or errno.EIO, f"{path}: {error.strerror}") from error
            end = self._ends[number] = End(number, fd, fd, path)
            self.fds[number] = fd
            return end

    def open_end(self, number: int) -> bool:
        path = os.path.join(self.path, f".w{number}")
        try:
            fd = more_descriptors(lambda: os.open(path, os.O_WRONLY | os.O_NONBLOCK | os.O_CLOEXEC))
        except (OSError, BusError):
            return False
        if len(self.fds) >= KEPT_ENDS:
            self._prune()
        if self.fds.setdefault(number, fd) != fd:
            os.close(fd)  # another thread was faster
        return True

    def forget_end(self, number: int) -> None:
        if number not in self._ends:
            fd = self.fds.pop(number, None)
            if fd is not None:
                os.close(fd)

    def _prune(self) -> None:
        for number, fd in list(self.fds.items()):
            if not os.fstat(fd).st_nlink:
                self.forget_end(number)

    # -- leaving -----------------------------------------------------------------------------------

    def close(self) -> None:
        with self._threads:
            if self.closed:
                return
            self._close_descriptors()
            super().close()

    def _close_descriptors(self) -> None:
        others = [fd for number, fd in self.fds.items() if number not in self._ends]
        for fd in [self._lock_fd, self._alive_fd, *others]:
            if fd >= 0:
                os.close(fd)
        self._lock_fd = self._alive_fd = -1
        self.fds.clear()

    def abandon(self) -> None:
        if self.closed:  # by another broker of the same folder
            return
        super().abandon()
        self._close_descriptors()
        for node in self.nodes.values():
            node.close()  # a copy of its flock descriptor would keep a dead parent's lock
        for end in self._ends.values():
            os.close(end.fd)
        self._ends.clear()


def process_directory(vehicle: str) -> SharedDirectory:
    """Return this process's directory of `vehicle`'s bus, opened when first asked for."""
    runtime = os.path.abspath(runtime_dir())
    with opening:
        directory = _open.get((runtime, vehicle))
        if directory is None or directory.closed:
            directory = _open[runtime, vehicle] = SharedDirectory(runtime, vehicle)
        return directory


opening = RLock()  # held while a process's directory is opened or closed
_open: dict[tuple[str, str], SharedDirectory] = {}
