"""The bus's folder: full, open to others, removed under us, of another layout, with odd files in it."""

import ctypes
import errno
import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

import uorb_net as uorb
from uorb_net.broker.layout import MAGIC
from uorb_net.msg import OrbTest, OrbTestLarge, OrbTestMedium

if TYPE_CHECKING:
    from tests.conftest import Script

Start = Callable[..., "Script"]
libc = ctypes.CDLL(None, use_errno=True)


@pytest.fixture
def small(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, script: Start) -> Iterator[Path]:
    """A RAM file system of 512 KiB as $UORB_RUNTIME_DIR."""
    place = tmp_path / "small"
    place.mkdir(mode=0o700)
    if libc.mount(b"tmpfs", str(place).encode(), b"tmpfs", 0, b"size=512k,mode=0700"):
        pytest.skip(f"cannot mount a RAM file system here: {os.strerror(ctypes.get_errno())}")
    monkeypatch.setenv("UORB_RUNTIME_DIR", str(place))
    yield place
    libc.umount2(str(place).encode(), 2)  # lazily: a failed test may have left it in use


def fill(place: Path) -> None:
    """Leave no free page."""
    with (place / "filler").open("wb", buffering=0) as file, suppress(OSError):
        while True:
            file.write(bytes(4096))
    assert not os.statvfs(place).f_bavail


def test_a_queue_that_does_not_fit(small: Path, script: Start) -> None:
    """BusError (ENOSPC) that says how much is needed and left; no half-built file; the bus stays usable."""
    with uorb.Broker() as broker:
        publication = broker.advertise(OrbTest, OrbTest(val=1), queue_length=2)
        subscription = broker.subscribe(OrbTest)
        waiting = broker.subscribe("orb_test_large", 1)
        calls: list[Callable[[], object]] = [
            lambda: broker.advertise(OrbTestLarge, queue_length=255),
            lambda: broker.advertise_multi(OrbTestLarge, queue_length=250),
        ]
        fill(small)
        calls.append(lambda: broker.subscribe(OrbTestMedium))
        for call in calls:
            with pytest.raises(uorb.BusError, match=r"needs \d+ bytes, the file system has \d+") as caught:
                call()
            assert caught.value.errno == errno.ENOSPC
        assert not broker.exists(OrbTestLarge)
        names = {status.topic for status in broker.topics()}
        assert names == {"orb_test", "orb_test_large"}
        assert not list(Path(broker.path).glob(".*.new"))
        assert subscription.copy().val == 1
        for value in range(200):
            publication.publish(OrbTest(val=value))
            assert subscription.copy().val == value
        assert not waiting.wait(0.01)
        reader = script("sub = uorb.Broker().subscribe('orb_test'); say(sub.copy().val)")
        assert reader.hear() == "199"
        os.unlink(small / "filler")
        assert broker.advertise(OrbTestLarge).queue_length == 1


def test_a_deeper_queue_that_does_not_fit(small: Path) -> None:
    """A replacement without room fails; subscriber and node stay as they were, and a shorter queue works."""
    with uorb.Broker() as broker:
        subscription = broker.subscribe(OrbTestLarge)
        fill(small)
        with pytest.raises(uorb.BusError) as caught:
            broker.advertise(OrbTestLarge, queue_length=100)
        assert caught.value.errno == errno.ENOSPC
        assert not subscription.advertised
        assert broker.topics()[0].publishers == 0
        publication = broker.advertise(OrbTestLarge)
        publication.publish(OrbTestLarge(val=4))
        assert subscription.copy().val == 4


def test_joining_a_full_file_system(small: Path, script: Start) -> None:
    """A process may join and use what is there, whatever its number; a first one on a full system gets BusError."""
    with uorb.Broker() as broker:
        broker.advertise(OrbTest, OrbTest(val=6))
        broker._directory.bulletin[1] = 511  # the next process's pid needs another page of .alive
        fill(small)
        reader = script("b = uorb.Broker(); say(b._directory.me, b.subscribe('orb_test').copy().val); hear()")
        assert reader.hear() == "512 6"
        assert sum(status.subscribers for status in broker.topics()) == 1
        first = script(
            """
try: uorb.Broker("another")
except uorb.BusError as error: say(error.errno == 28, "another" in str(error))
"""
        )
        assert first.hear() == "True True"


@pytest.mark.parametrize("mode", [0o777, 0o770, 0o702, 0o720])
def test_a_runtime_folder_that_others_may_write_to(runtime_dir: Path, mode: int) -> None:
    """BusError (EPERM) that names the folder, its mode and the way out."""
    runtime_dir.chmod(mode)
    with pytest.raises(uorb.BusError, match=f"{mode:04o}") as caught:
        uorb.Broker()
    assert caught.value.errno == errno.EPERM
    assert str(runtime_dir) in str(caught.value)
    runtime_dir.chmod(0o755)
    uorb.Broker().close()


def test_a_vehicle_folder_that_others_may_look_into(runtime_dir: Path) -> None:
    """The vehicle's own folder must be 0700."""
    (runtime_dir / "default").mkdir(mode=0o755)
    with pytest.raises(uorb.BusError, match="chmod 700") as caught:
        uorb.Broker()
    assert caught.value.errno == errno.EPERM


@pytest.mark.parametrize("what", ["link", "dangling link", "file"])
def test_a_vehicle_folder_that_is_none(runtime_dir: Path, tmp_path: Path, what: str) -> None:
    """A symbolic link or a file in the folder's place is refused."""
    place = runtime_dir / "default"
    elsewhere = tmp_path / "elsewhere"
    if what == "file":
        place.touch()
    else:
        place.symlink_to(elsewhere)
    if what == "link":
        elsewhere.mkdir(mode=0o700)
    with pytest.raises(uorb.BusError) as caught:
        uorb.Broker()
    assert caught.value.errno in (errno.ENOTDIR, errno.EEXIST)
    assert what == "file" or not list(tmp_path.glob("elsewhere/*"))


def test_a_folder_of_someone_else(runtime_dir: Path) -> None:
    """BusError (EPERM) that names the owner."""
    if os.getuid():
        pytest.skip("giving a folder away needs root")
    os.chown(runtime_dir, 12345, -1)
    with pytest.raises(uorb.BusError, match="12345") as caught:
        uorb.Broker()
    assert caught.value.errno == errno.EPERM


def test_a_runtime_folder_that_cannot_be_made(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A file in the way is BusError with the system's errno and a hint."""
    (tmp_path / "file").touch()
    monkeypatch.setenv("UORB_RUNTIME_DIR", str(tmp_path / "file" / "below"))
    with pytest.raises(uorb.BusError, match="UORB_RUNTIME_DIR") as caught:
        uorb.Broker()
    assert caught.value.errno == errno.ENOTDIR


def test_a_runtime_folder_is_made_where_there_is_none(runtime_dir: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With mode 0700, also several levels deep."""
    deep = runtime_dir / "a" / "b"
    monkeypatch.setenv("UORB_RUNTIME_DIR", str(deep))
    with uorb.Broker():
        assert deep.stat().st_mode & 0o777 == 0o700
        assert (deep / "default").stat().st_mode & 0o777 == 0o700


def test_the_folder_is_removed_under_running_processes(runtime_dir: Path, script: Start) -> None:
    """What is open works on; opening anything is BusError (ESTALE), so that the bus never splits; closing works."""
    with uorb.Broker() as broker:
        publication = broker.advertise(OrbTest, OrbTest(val=1))
        other = script("pub = uorb.Broker().advertise('orb_test'); say('ready'); hear()")
        other.hear()
        subscription = broker.subscribe(OrbTest)
        publication.publish(OrbTest(val=1))
        shutil.rmtree(broker.path)
        publication.publish(OrbTest(val=2))
        assert subscription.copy().val == 2
        for call in (broker.advertise, broker.advertise_multi, broker.subscribe):
            with pytest.raises(uorb.BusError, match="restart") as caught:
                call(OrbTestMedium)
            assert caught.value.errno == errno.ESTALE
        with pytest.raises(uorb.BusError):
            subscription.wait(0.5)  # needs a FIFO in the folder
        assert not broker.exists(OrbTest)
    with uorb.Broker() as broker:
        assert broker.topics() == []
        broker.advertise(OrbTest, OrbTest())


def test_publishing_among_several_into_a_removed_folder(shared: uorb.Broker, script: Start) -> None:
    """A publisher that needs the node's file for its first shared write gets BusError (ESTALE)."""
    publication = shared.advertise(OrbTest)
    script("pub = uorb.Broker().advertise('orb_test'); say('ready'); hear()").hear()
    shutil.rmtree(shared.path)
    with pytest.raises(uorb.BusError) as caught:
        publication.publish(OrbTest())
    assert caught.value.errno == errno.ESTALE


def test_a_file_that_is_no_node(shared: uorb.Broker) -> None:
    """BusError (EPROTO) that says which file to remove."""
    Path(shared.path, "orb_test").write_bytes(b"x" * 100)
    Path(shared.path, "orb_test_medium").write_bytes(b"x" * 10000)
    for topic in (OrbTest, OrbTestMedium):
        with pytest.raises(uorb.BusError, match="remove it") as caught:
            shared.subscribe(topic)
        assert caught.value.errno == errno.EPROTO
    Path(shared.path, "orb_test").unlink()
    shared.advertise(OrbTest, OrbTest())


def stamp(path: str, magic: int, rest: bytes = b"") -> None:
    """Write a layout version, and what that layout may have behind it, into the folder's .bus."""
    with Path(path, ".bus").open("r+b") as file:
        file.write(magic.to_bytes(8, "little") + rest)


def test_another_layout_with_somebody_alive(shared: uorb.Broker, script: Start) -> None:
    """Refused with the pid and both versions; a failed try leaves no descriptor open."""
    shared.advertise(OrbTest)
    stamp(shared.path, MAGIC + 1)
    other = script(
        """
before = len(os.listdir("/proc/self/fd"))
for _ in range(3):
    try: uorb.Broker()
    except uorb.BusError as error: text, number = str(error), error.errno
say(number, len(os.listdir("/proc/self/fd")) - before, text)
"""
    )
    number, left, text = other.hear().split(maxsplit=2)
    assert (int(number), int(left)) == (errno.EPROTO, 0)
    assert f"process {os.getpid()} with layout {(MAGIC + 1) & 0xFFFFFFFF}" in text
    assert f"this is layout {MAGIC & 0xFFFFFFFF}" in text
    stamp(shared.path, MAGIC)


def test_another_layout_with_nobody_alive(runtime_dir: Path) -> None:
    """Swept, and begun anew."""
    with uorb.Broker() as broker:
        broker.advertise(OrbTest, OrbTest())
    stamp(broker.path, MAGIC + 1, b"\xff" * 1000)
    Path(broker.path, "old_node").write_bytes(b"x" * 100)
    with uorb.Broker() as broker:
        assert broker.topics() == []
        broker.advertise(OrbTest, OrbTest(val=2))
        assert broker.subscribe(OrbTest).copy().val == 2
        assert 0 < broker._directory.me < 100
        assert set(os.listdir(broker.path)) == {".lock", ".alive", ".bus", "orb_test"}


def test_a_bus_without_the_living_is_emptied(runtime_dir: Path, script: Start) -> None:
    """The first process after all others died finds no nodes, no FIFOs and no half-built files."""
    crowd = script(
        """
broker = uorb.Broker()
pub = broker.advertise("orb_test", msg.OrbTest()); sub = broker.subscribe("orb_test_medium"); sub.wait(0.01)
open(broker.path + "/.orb_test.new", "w").close()
say("ready"); hear()
"""
    )
    crowd.hear()
    with uorb.Broker() as broker:
        assert {status.topic for status in broker.topics()} == {"orb_test", "orb_test_medium"}
        assert not list(Path(broker.path).glob(".*.new"))  # who joins sweeps that much
        number = broker._directory.me
        fifos = list(Path(broker.path).glob(".w*"))
        assert len(fifos) == 1
    crowd.kill()
    with uorb.Broker() as broker:
        assert broker.topics() == []
        assert set(os.listdir(broker.path)) == {".lock", ".alive", ".bus"}
        assert broker._directory.me > number  # numbers are never given twice
        publication = broker.advertise(OrbTest)
        publication.publish(OrbTest())
        assert broker.topics()[0].generation == 1


def test_killed_while_joining(runtime_dir: Path, script: Start) -> None:
    """A process killed at any step of opening the bus leaves it usable."""
    for victim in ("os.pwrite", "os.listdir", "mmap.mmap", "os.posix_fallocate", "fcntl.fcntl"):
        module, name = victim.split(".")
        die = f"import {module}\n{victim} = lambda *_, **__: os.kill(os.getpid(), 9)\n"
        dying = script(die + f"uorb.Broker('{name}')")
        assert dying.ends() == -9, victim
        with uorb.Broker(name) as broker:
            broker.advertise(OrbTest, OrbTest(val=1))
            assert broker.subscribe(OrbTest).copy().val == 1


def test_killed_while_building_or_changing_a_node(shared: uorb.Broker, script: Start) -> None:
    """Death at any step of advertise, subscribe, wait or unadvertise leaves no trace that matters."""
    code = """
from uorb_net.broker import members, shared, node as nodes, tables
step, victim = sys.argv[1], sys.argv[2]
module, _, name = victim.rpartition(".")
place = {"members": members, "shared": shared, "os": os, "Node": nodes.Node}[module]
broker = uorb.Broker()
def die(*_, **__): os.kill(os.getpid(), 9)
if step in ("advertise", "subscribe"): setattr(place, name, die)
user = broker.subscribe("orb_test") if step in ("subscribe", "wait", "close") else broker.advertise("orb_test")
setattr(place, name, die)
user.wait(1) if step == "wait" else user.close()
"""
    victims = [
        ("advertise", "os.posix_fallocate"), ("advertise", "shared.format_node"), ("advertise", "os.rename"),
        ("advertise", "members.begin_advertisement"), ("advertise", "members.add_share"),
        ("advertise", "Node.settle_writers"), ("subscribe", "members.claim_subscriber"),
        ("subscribe", "Node.refresh_subscriber"), ("wait", "os.mkfifo"), ("close", "members.release_subscriber"),
        ("unadvertise", "members.drop_share"), ("unadvertise", "members.purge"), ("unadvertise", "Node.leave_writers"),
    ]  # fmt: skip
    for step, victim in victims:
        dying = script(code, step, victim)
        assert dying.ends() == -9, (step, victim)
        assert not shared.exists(OrbTest)
        with shared.advertise_multi(OrbTest) as publication, shared.subscribe(OrbTest) as subscription:
            assert publication.instance == 0
            publication.publish(OrbTest(val=3))
            assert subscription.copy().val == 3
            [status] = shared.topics()
            assert (status.publishers, status.subscribers) == (1, 1)
        Path(shared.path, "orb_test").unlink()


def test_two_paths_to_one_folder(runtime_dir: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The same folder under two spellings is one bus."""
    with uorb.Broker() as one:
        monkeypatch.setenv("UORB_RUNTIME_DIR", f"{runtime_dir}/./")
        with uorb.Broker() as other:
            publication: uorb.Publication[Any] = one.advertise(OrbTest)
            assert other._directory is one._directory
            publication.publish(OrbTest(val=1))
            assert other.subscribe(OrbTest).copy().val == 1
