"""A node under fire: publishers and readers killed and stopped at random instants, and born again.

UORB_STORM_KILLS sets how many are killed (300); `make soak` runs more.
"""

import mmap
import os
import signal
from collections.abc import Callable
from pathlib import Path
from random import Random
from time import monotonic, sleep
from typing import TYPE_CHECKING

import pytest

import uorb_net as uorb
from uorb_net.msg import OrbTestLarge

if TYPE_CHECKING:
    from tests.conftest import Script

KILLS = int(os.environ.get("UORB_STORM_KILLS", "300"))
SEED = int(os.environ.get("UORB_STORM_SEED", "0")) or int.from_bytes(os.urandom(4), "little")

# Forks publishers and readers on request: a birth costs milliseconds, so that kills can come close together.
# Each counts its rounds in a word of `progress`; readers append (number, digest) to `log` and faults to `faults`.
NURSERY = """
import errno, hashlib, mmap, random, struct, warnings
warnings.simplefilter("ignore", DeprecationWarning)
folder = sys.argv[1]
signal.signal(signal.SIGCHLD, signal.SIG_IGN)
with open(folder + "/progress", "r+b") as file: words = memoryview(mmap.mmap(file.fileno(), 4096)).cast("Q")
append = os.O_WRONLY | os.O_APPEND | os.O_CREAT
Large = msg.OrbTestLarge

def fault(*text):
    fd = os.open(folder + "/faults", append)
    os.write(fd, (" ".join(map(str, text)) + "\\n").encode())
    os.close(fd)

def publisher(place, draw):
    broker = uorb.Broker()
    k = 0
    while True:
        words[place] += 1
        try:
            pub = broker.advertise("orb_test_large", queue_length=draw.choice([2, 16, 16, 40]))
            end = time.monotonic() + draw.random() * 0.4
            while time.monotonic() < end:
                k += 1
                head = struct.pack("<QQ", os.getpid(), k) + draw.randbytes(464)
                try: pub.publish(Large(val=k, junk=head + hashlib.sha256(head).digest()))
                except uorb.BusyError: pass
                words[place] += 1
                if not k % 64: time.sleep(draw.choice([0, 0.001, 0.01]))
            pub.unadvertise()
        except uorb.BusyError: pass

def reader(place, draw):
    broker = uorb.Broker()
    log = os.open(folder + "/log", append)
    while True:
        sub = broker.subscribe("orb_test_large", start=draw.choice(["latest", "new", "oldest"]))
        other = broker.subscribe("orb_test")
        end = time.monotonic() + draw.random() * 1.5
        newest = 0
        while time.monotonic() < end:
            words[place] += 1
            way = draw.randrange(3)
            if way == 0: sub.wait(0.1)
            elif way == 1: uorb.poll([other, sub], 0.1)
            for _ in range(50):
                before = sub.generation
                if not sub.check(): break
                try: message, info = sub.copy_with_info()
                except uorb.NoDataError: break
                if hashlib.sha256(message.junk[:480]).digest() != message.junk[480:]: fault("torn", info)
                if info.generation <= newest: fault("out of order", info, newest)
                if sub.generation != info.generation or before >= sub.generation: fault("position", before, info)
                newest = info.generation
                os.write(log, struct.pack("<Q", info.generation) + message.junk[480:488])
        sub.close(); other.close()

for line in sys.stdin:
    role, place, seed = line.split()
    pid = os.fork()
    if not pid:
        signal.signal(signal.SIGCHLD, signal.SIG_DFL)
        try: globals()[role](int(place), random.Random(int(seed)))
        except BaseException as error:
            import traceback
            fault(role, repr(error), traceback.format_exc())
        os._exit(1)
    say(pid)
"""
ROLES = ("publisher", "publisher", "reader", "reader")


@pytest.mark.timeout(60 + KILLS)
def test_storm(
    shared: uorb.Broker, script: Callable[..., "Script"], tmp_path: Path, eventually: Callable[..., bool]
) -> None:
    """Nothing torn, out of order or written twice; nobody stuck; afterwards only the living are on the bus."""
    draw = Random(SEED)
    faults = tmp_path / "faults"
    (tmp_path / "progress").write_bytes(bytes(4096))
    with (tmp_path / "progress").open("r+b") as file:
        words = memoryview(mmap.mmap(file.fileno(), 4096)).cast("Q")
    nursery = script(NURSERY, tmp_path)
    born = [0]

    def birth(place: int) -> int:
        born[0] += 1
        return int(nursery.ask(ROLES[place], place, SEED + born[0]))

    def gone(pid: int) -> bool:
        return not Path(f"/proc/{pid}").exists()

    pids = [birth(place) for place in range(len(ROLES))]
    stopped: dict[int, float] = {}  # by place: until when
    try:
        for _ in range(KILLS):
            until = monotonic() + draw.random() * 0.13
            while monotonic() < until:
                for place in [place for place, end in stopped.items() if monotonic() > end]:
                    os.kill(pids[place], signal.SIGCONT)
                    del stopped[place]
                sleep(0.003)
            place = draw.randrange(len(ROLES))
            if draw.random() < 0.2 and place not in stopped:
                os.kill(pids[place], signal.SIGSTOP)
                stopped[place] = monotonic() + draw.random() * 0.25
                place = (place + 1 + draw.randrange(3)) % len(ROLES)
            assert not gone(pids[place]), faults.read_text() if faults.exists() else "a process ended by itself"
            os.kill(pids[place], signal.SIGKILL)
            stopped.pop(place, None)
            assert eventually(lambda pid=pids[place]: gone(pid), 5.0)
            pids[place] = birth(place)
        for place in stopped:
            os.kill(pids[place], signal.SIGCONT)
        before = list(words[: len(ROLES)])
        assert eventually(lambda: all(words[n] > before[n] for n in range(len(ROLES))), 3.0), f"stuck (seed {SEED})"
        assert not faults.exists(), f"seed {SEED}: {faults.read_text()}"
    finally:
        for pid in pids:
            os.kill(pid, signal.SIGKILL)
    assert eventually(lambda: all(map(gone, pids)), 5.0)
    _check_log(tmp_path / "log")
    assert not any(status.publishers or status.subscribers or status.advertised for status in shared.topics())
    script("uorb.Broker(); say('joined')").hear()  # who joins tidies up
    left = {path.name for path in Path(shared.path).iterdir()}
    assert left == {".lock", ".alive", ".bus", "orb_test_large", "orb_test"}
    with shared.advertise(OrbTestLarge) as publication, shared.subscribe(OrbTestLarge) as subscription:
        publication.publish(OrbTestLarge(val=77))
        assert subscription.wait(1.0)
        assert subscription.copy().val == 77


def _check_log(path: Path) -> None:
    """No number may have two contents; both readers together saw much."""
    data = path.read_bytes()
    seen: dict[bytes, bytes] = {}
    for at in range(0, len(data) - 15, 16):
        number, digest = data[at : at + 8], data[at + 8 : at + 16]
        assert seen.setdefault(number, digest) == digest, f"seed {SEED}: two contents for one number"
    assert len(seen) > 5 * KILLS
