"""One bus, several processes: who comes first, who dies, who publishes together, who is stopped."""

import os
import signal
from collections.abc import Callable
from hashlib import sha256
from pathlib import Path
from time import monotonic
from typing import TYPE_CHECKING

import pytest

import uorb_net as uorb
from uorb_net.broker.layout import W_BUSY, W_G, W_SHARED
from uorb_net.msg import OrbTest, OrbTestLarge, OrbTestMedium

if TYPE_CHECKING:
    from tests.conftest import Script

Start = Callable[..., "Script"]
Eventually = Callable[..., bool]

PUBLISHER = """
broker = uorb.Broker()
pub = broker.advertise("orb_test")
say("ready")
for line in sys.stdin:
    pub.publish(msg.OrbTest(val=int(line)))
    say("done")
"""
READER = """
sub = uorb.Broker().subscribe("orb_test")
say("ready")
while sub.wait(20):
    say(sub.copy().val)
"""


def test_a_subscriber_may_come_first(shared: uorb.Broker, script: Start) -> None:
    """It makes the node; what a later publisher in another process publishes wakes it."""
    reader = script(READER)
    assert reader.hear() == "ready"
    [status] = shared.topics()
    assert (status.subscribers, status.publishers, status.advertised) == (1, 0, False)
    publication = shared.advertise(OrbTest)
    for value in range(50):
        publication.publish(OrbTest(val=value))
        assert reader.hear() == str(value)


def test_a_publisher_may_come_first(shared: uorb.Broker, script: Start) -> None:
    """What it published is there for a later subscriber in another process, and visible when publish returns."""
    publisher = script(PUBLISHER)
    assert publisher.hear() == "ready"
    assert shared.exists(OrbTest)
    assert publisher.ask(1) == "done"
    subscription = shared.subscribe(OrbTest)
    assert subscription.copy().val == 1
    for value in range(2, 50):
        assert publisher.ask(value) == "done"
        assert subscription.check()
        assert subscription.copy().val == value


def test_a_process_that_ends_takes_its_publications_along(shared: uorb.Broker, script: Start) -> None:
    """A normal end unadvertises and unsubscribes, without a call."""
    other = script("b = uorb.Broker(); p = b.advertise('orb_test', msg.OrbTest()); s = b.subscribe('orb_test'); say(1)")
    assert other.hear() == "1"
    assert other.ends() == 0
    [status] = shared.topics()
    assert (status.advertised, status.publishers, status.subscribers) == (False, 0, 0)
    assert not list(Path(shared.path).glob(".w*"))


@pytest.mark.parametrize("stopped", [False, True])
def test_a_killed_publisher_is_unadvertised(
    shared: uorb.Broker, script: Start, eventually: Eventually, *, stopped: bool
) -> None:
    """Within a second for topics, exists, check and copy; also one that was stopped when it was killed."""
    publisher = script(PUBLISHER)
    subscription = shared.subscribe(OrbTest)
    publisher.hear()
    publisher.ask(5)
    assert subscription.check()
    if stopped:
        publisher.stop()
        assert shared.exists(OrbTest)
        assert subscription.check()
    publisher.kill()
    died = monotonic()
    assert not shared.exists(OrbTest)
    assert not shared.topics()[0].advertised
    assert shared.topics()[0].publishers == 0
    assert shared.group_count(OrbTest) == 0
    assert eventually(lambda: not subscription.check(), 1.0)
    assert monotonic() - died < 1.0
    assert not subscription.advertised
    assert subscription.pending == 0
    with pytest.raises(uorb.NoDataError):
        subscription.copy()
    again = shared.advertise_multi(OrbTest)
    assert again.instance == 0
    assert not subscription.check()
    again.publish(OrbTest(val=6))
    assert subscription.copy().val == 6


def test_copy_finds_a_death_without_check(shared: uorb.Broker, script: Start, eventually: Eventually) -> None:
    """`copy` alone raises NoDataError within a second of the kill, and so does `advertised` turn false."""
    publisher = script(PUBLISHER)
    publisher.hear()
    publisher.ask(5)
    one, other = shared.subscribe(OrbTest), shared.subscribe(OrbTest)
    one.copy()
    publisher.kill()

    def refused() -> bool:
        try:
            one.copy()
        except uorb.NoDataError:
            return True
        return False

    assert eventually(refused, 1.0)
    assert eventually(lambda: not other.advertised, 1.0)


def test_a_death_leaves_the_co_publisher(shared: uorb.Broker, script: Start) -> None:
    """The topic stays while another process publishes it."""
    dying, living = script(PUBLISHER), script(PUBLISHER)
    for one in (dying, living):
        assert one.hear() == "ready"
        assert one.ask(1) == "done"
    subscription = shared.subscribe(OrbTest)
    subscription.copy()
    dying.kill()
    assert shared.exists(OrbTest)
    assert shared.topics()[0].publishers == 1
    assert living.ask(2) == "done"
    assert subscription.copy().val == 2


def test_a_subscriber_killed_in_its_sleep(shared: uorb.Broker, script: Start, eventually: Eventually) -> None:
    """It is counted no more, disturbs no publisher, and its FIFO goes with the next who tidies up."""
    publication = shared.advertise(OrbTest)
    sleepers = [script(READER) for _ in range(3)]
    for sleeper in sleepers:
        sleeper.hear()
    assert eventually(lambda: len(list(Path(shared.path).glob(".w*"))) == 3)
    for sleeper in sleepers[:2]:
        sleeper.kill()
    for value in range(10):
        publication.publish(OrbTest(val=value))
    assert eventually(lambda: sleepers[2].hear() == "9")
    assert shared.topics()[0].subscribers == 1
    with uorb.Broker("default"):
        shared.advertise(OrbTest)
    script("uorb.Broker(); say('joined')").hear()
    assert len(list(Path(shared.path).glob(".w*"))) == 1


def test_losses_of_a_killed_subscriber_stay_in_the_sum(shared: uorb.Broker, script: Start) -> None:
    """What a dead process lost is the node's loss still."""
    publication = shared.advertise(OrbTest)
    reader = script("sub = uorb.Broker().subscribe('orb_test'); say(1); hear(); sub.copy(); say(sub.lost); hear()")
    reader.hear()
    for _ in range(5):
        publication.publish(OrbTest())
    assert reader.ask("go") == "4"
    assert shared.topics()[0].lost == 4
    reader.kill()
    assert shared.topics()[0].lost == 4
    shared.subscribe(OrbTest)  # clears the entry
    assert shared.topics()[0].lost == 4


JOINT = """
import hashlib
broker = uorb.Broker()
me, count = int(sys.argv[1]), int(sys.argv[2])
say("ready"); hear()
pub = broker.advertise("orb_test_medium", queue_length=255)
written = 0
for k in range(count):
    head = me.to_bytes(4, "little") + k.to_bytes(4, "little") + os.urandom(24)
    pub.publish(msg.OrbTestMedium(val=k, junk=head + hashlib.sha256(head).digest()))
    if k % 50 == 0 and me:  # leave and join again: solo begins and ends, again and again
        pub.unadvertise()
        pub = broker.advertise("orb_test_medium", queue_length=255)
say("done"); hear()
"""


def test_processes_publish_together(shared: uorb.Broker, script: Start) -> None:
    """G is the sum of all publications, every sample whole, no number twice, each publisher's in its order."""
    count, writers = 3000, 3
    keeper = shared.advertise("orb_test_medium", queue_length=255)
    subscription = shared.subscribe("orb_test_medium")
    children = [script(JOINT, n, count) for n in range(writers)]
    for child in children:
        child.hear()
    for child in children:
        child.say("go")
    seen: dict[int, bytes] = {}
    while len(seen) + subscription.lost < writers * count:
        assert subscription.wait(20.0), (len(seen), subscription.lost)
        message, info = subscription.copy_with_info()
        assert info.generation not in seen
        seen[info.generation] = message.junk
    for child in children:
        assert child.hear() == "done"
    assert shared.topics()[0].generation == writers * count
    assert sorted(seen) == list(seen)
    newest: dict[bytes, int] = {}
    for junk in seen.values():
        assert sha256(junk[:32]).digest() == junk[32:]
        number = int.from_bytes(junk[4:8], "little")
        assert newest.get(junk[:4], -1) < number
        newest[junk[:4]] = number
    assert keeper.queue_length == 255
    assert len(seen) >= 255


STOPS = """
broker = uorb.Broker()
pub = broker.advertise("orb_test")
pub.publish(msg.OrbTest(val=1))
say("ready"); hear()
mapping = pub._node.mapping
pack = mapping.pack
def stopping(*fields):
    mapping.pack = pack
    pack(*fields)
    os.kill(os.getpid(), signal.SIGSTOP)
    pack(*fields)
mapping.pack = stopping
if sys.argv[1] == "signalled": hear()
pub.publish(msg.OrbTest(val=2))
say("published"); hear()
pub.publish(msg.OrbTest(val=4))
say("published"); hear()
"""


@pytest.mark.parametrize("kind", ["solo", "shared"])
def test_a_co_publisher_stopped_in_the_act(shared: uorb.Broker, script: Start, kind: str) -> None:
    """BusyError (EAGAIN) after 0.1 s, nothing published, readers unharmed; all goes on when it goes on."""
    publication = shared.advertise(OrbTest) if kind == "shared" else None
    other = script(STOPS, "")
    assert other.hear() == "ready"
    if publication is not None:
        publication.publish(OrbTest(val=0))
    subscription = shared.subscribe(OrbTest)
    before = shared.topics()[0].generation
    other.say("go")
    other.await_stop()
    publication = publication or shared.advertise(OrbTest)
    for _ in range(3):
        started = monotonic()
        with pytest.raises(uorb.BusyError, match=str(other.pid)) as caught:
            publication.publish(OrbTest(val=9))
        assert 0.09 < monotonic() - started < 1.0
        assert caught.value.errno == 11
    assert shared.topics()[0].generation == before
    assert subscription.copy().val in (0, 1)
    other.signal(signal.SIGCONT)
    assert other.hear() == "published"
    assert subscription.copy().val == 2
    publication.publish(OrbTest(val=3))
    assert subscription.copy().val == 3
    assert other.ask("go") == "published"
    assert subscription.copy().val == 4
    assert shared.topics()[0].generation == before + 3


@pytest.mark.parametrize("kind", ["solo", "shared"])
def test_a_co_publisher_killed_in_the_act(shared: uorb.Broker, script: Start, kind: str) -> None:
    """A half-written sample is never seen, and blocks nobody, also when its writer was stopped first."""
    publication = shared.advertise(OrbTest) if kind == "shared" else None
    other = script(STOPS, "")
    assert other.hear() == "ready"
    if publication is not None:
        publication.publish(OrbTest(val=0))
    other.say("go")
    other.await_stop()
    subscription = shared.subscribe(OrbTest)
    publication = publication or shared.advertise(OrbTest)
    generation = shared.topics()[0].generation
    other.kill()
    started = monotonic()
    publication.publish(OrbTest(val=7))
    assert monotonic() - started < 0.5
    assert subscription.copy().val == 7
    assert shared.topics()[0].generation == generation + 1
    with shared.advertise(OrbTest):  # now it is alone, and knows
        publication.publish(OrbTest(val=8))
    words = publication._node.mapping.words
    assert (words[W_SHARED], words[W_BUSY]) == (0, 0)
    assert words[W_G] == generation + 2


def test_solo_comes_back_when_a_publisher_is_alone(shared: uorb.Broker, script: Start) -> None:
    """An advertise that finds nobody else alive makes its process solo again; one that joins ends it."""
    publication = shared.advertise(OrbTest)
    words = publication._node.mapping.words
    assert words[W_SHARED] == 0
    other = script(PUBLISHER)
    other.hear()
    assert words[W_SHARED] == 1
    publication.publish(OrbTest(val=1))
    assert other.ask(2) == "done"
    publication.publish(OrbTest(val=3))
    other.kill()
    publication.publish(OrbTest(val=4))
    with shared.advertise(OrbTest):
        assert words[W_SHARED] == 0
    publication.publish(OrbTest(val=5))
    third = script(PUBLISHER)
    third.hear()
    assert third.ask(6) == "done"
    assert words[W_SHARED] == 1
    assert words[W_G] == 6


def test_a_process_stopped_with_the_directory_lock(shared: uorb.Broker, script: Start) -> None:
    """Advertising raises BusError (EAGAIN) naming its pid; publishing and reading go on."""
    publication = shared.advertise(OrbTest)
    subscription = shared.subscribe(OrbTest)
    holder = script("with uorb.Broker()._directory.hold(): say('held'); hear()")
    holder.hear()
    holder.stop()
    with pytest.raises(uorb.BusError, match=str(holder.pid)) as caught, shared._directory.hold(0.2):
        pass
    assert caught.value.errno == 11
    publication.publish(OrbTest(val=3))
    assert subscription.copy().val == 3
    assert shared.exists(OrbTest)
    holder.kill()
    shared.advertise(OrbTest)


def test_joining_while_the_directory_lock_is_held(shared: uorb.Broker, script: Start) -> None:
    """A process that cannot join is told by whom, too."""
    holder = script("with uorb.Broker()._directory.hold(): say('held'); hear()")
    holder.hear()
    newcomer = script(
        """
from uorb_net.broker.shared import SharedDirectory
SharedDirectory.hold.__wrapped__.__defaults__ = (0.1,)
try: uorb.Broker()
except uorb.BusError as error: say(error.errno, error)
"""
    )
    answer = newcomer.hear()
    assert answer.startswith("11 ")
    assert f"process {holder.pid} " in answer


def test_unadvertising_while_the_bus_cannot_be_told(
    shared: uorb.Broker, script: Start, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With the directory lock held by a stopped process it is BusError; a second call tries again."""
    publication = shared.advertise(OrbTest)
    hold = shared._directory.hold
    monkeypatch.setattr(shared._directory, "hold", lambda wait=0.05: hold(min(wait, 0.05)))
    holder = script("with uorb.Broker()._directory.hold(): say('held'); hear()")
    holder.hear()
    for _ in range(2):
        with pytest.raises(uorb.BusError, match=str(holder.pid)):
            publication.unadvertise()
        with pytest.raises(uorb.ClosedError):
            publication.publish(OrbTest())
        assert shared.exists(OrbTest)
    holder.kill()
    publication.unadvertise()
    assert not shared.exists(OrbTest)
    publication.unadvertise()


def test_a_reader_is_not_held_up_by_the_directory_lock(shared: uorb.Broker, script: Start) -> None:
    """A dead publisher's topic reads as unadvertised even while someone sits on the directory lock."""
    publisher = script(PUBLISHER)
    publisher.hear()
    publisher.ask(1)
    subscription = shared.subscribe(OrbTest)
    holder = script("with uorb.Broker()._directory.hold(): say('held'); hear()")
    holder.hear()
    publisher.kill()
    started = monotonic()
    while subscription.check():
        assert monotonic() - started < 1.0
    started = monotonic()
    with pytest.raises(uorb.NoDataError):
        subscription.copy()
    assert monotonic() - started < 1.0


def test_instances_are_taken_atomically(shared: uorb.Broker, script: Start) -> None:
    """Processes that all call advertise_multi at one moment get different numbers; the eleventh gets none."""
    code = """
broker = uorb.Broker()
say("ready"); hear()
try: pub = broker.advertise_multi("orb_multitest"); say(pub.instance)
except uorb.InstanceError: say("none")
hear()
"""
    children = [script(code) for _ in range(11)]
    for child in children:
        child.hear()
    for child in children:
        child.say("go")
    answers = sorted(child.hear() for child in children)
    assert answers == [*map(str, range(10)), "none"]
    assert shared.group_count("orb_multitest") == 10
    for child in children:
        child.kill()
    assert shared.group_count("orb_multitest") == 0
    assert shared.advertise_multi("orb_multitest").instance == 0


def test_large_samples_between_processes(shared: uorb.Broker, script: Start) -> None:
    """Every sample read while another process publishes flat out is whole."""
    script(
        """
pub = uorb.Broker().advertise("orb_test_large")
k = 0
while True:
    k += 1
    pub.publish(msg.OrbTestLarge(val=k, junk=bytes([k % 256]) * 512))
"""
    )
    subscription = shared.subscribe(OrbTestLarge)
    newest = 0
    assert subscription.wait(20.0)
    seen = 0
    until = monotonic() + 30.0
    while seen < 5000 and monotonic() < until:
        message = subscription.update()
        if message is None:
            continue
        assert message.junk == bytes([message.val % 256]) * 512
        assert message.val > newest
        newest = message.val
        seen += 1
    assert seen == 5000


def test_queued_samples_in_a_burst_between_processes(shared: uorb.Broker, script: Start) -> None:
    """A burst that fits the queue arrives whole and in order, whenever the reader gets to run."""
    reader = script(
        """
sub = uorb.Broker().subscribe("orb_test_medium")
say("ready")
for _ in range(20):
    hear()
    say(*[m.val for m in iter(sub.update, None)])
"""
    )
    reader.hear()
    publication = shared.advertise(OrbTestMedium)
    for burst in range(20):
        numbers = range(burst * 16, burst * 16 + 16)
        for value in numbers:
            publication.publish(OrbTestMedium(val=value))
        assert reader.ask("read") == " ".join(map(str, numbers))


def test_everything_created_is_private_to_the_user(shared: uorb.Broker, script: Start) -> None:
    """Folders 0700, files and FIFOs 0600, whatever the umask."""
    code = """
os.umask(0)
broker = uorb.Broker("open")
pub = broker.advertise("orb_test", msg.OrbTest()); sub = broker.subscribe("orb_test"); sub.copy(); sub.wait(0.01)
sub.fileno()
say("ready"); hear()
"""
    script(code).hear()
    folder = os.path.join(os.path.dirname(shared.path), "open")
    assert os.stat(folder).st_mode & 0o777 == 0o700
    modes = {entry.name: entry.stat().st_mode & 0o777 for entry in os.scandir(folder)}
    assert {".lock", ".bus", ".alive", "orb_test"} < set(modes)
    assert any(name.startswith(".w") for name in modes)
    assert set(modes.values()) == {0o600}
