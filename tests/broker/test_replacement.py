"""A node's file replaced under running processes: nothing lost, nobody stuck, whenever the mover is killed."""

import signal
from collections.abc import Callable
from pathlib import Path
from time import monotonic
from typing import TYPE_CHECKING, Any

import pytest

import uorb_net as uorb
from uorb_net.broker import growth, members
from uorb_net.broker.layout import MOVED, W_G
from uorb_net.msg import OrbTest

if TYPE_CHECKING:
    from tests.conftest import Script, Task

Start = Callable[..., "Script"]
InThread = Callable[[Callable[[], object]], "Task"]

DEEP = "pub = uorb.Broker().advertise('orb_test', queue_length=int(sys.argv[1])); say('ready')\n"
MOVER = """
from uorb_net.broker import growth, members
broker = uorb.Broker()
sub = broker.subscribe("orb_test")
node = sub._node
def move(retained):
    with broker._directory.hold():
        members._follow(node)
        growth.replace(node, node.mapping.queue_length, retained)
"""


def move(broker: uorb.Broker, subscription: uorb.Subscription[Any], retained: int) -> None:
    """Replace a node's file by one that keeps more (or fewer) samples; readers see the same queue length."""
    with broker._directory.hold():
        members._follow(subscription._node)
        growth.replace(subscription._node, subscription.queue_length, retained)


def values(subscription: uorb.Subscription[Any]) -> list[int]:
    """Return the values of all updates."""
    return [m.val for m in iter(subscription.update, None)]


def test_a_deeper_publisher_replaces_the_subscribers_node(shared: uorb.Broker, script: Start) -> None:
    """Subscriber with n = 1, then advertise with 64 elsewhere: the reader gets all 64, and its wait survives."""
    subscription = shared.subscribe(OrbTest)
    assert subscription.queue_length == 1
    other = script(DEEP + "hear()\nfor k in range(64): pub.publish(msg.OrbTest(val=k))\nsay('done'); hear()", 64)
    other.hear()
    assert not subscription.check()
    assert subscription.queue_length == 64
    assert other.ask("go") == "done"
    assert subscription.wait(5.0)
    assert values(subscription) == list(range(64))
    assert subscription.lost == 0


def test_a_wait_survives_a_replacement(shared: uorb.Broker, script: Start, in_thread: InThread) -> None:
    """A sleeper in the old file is woken by a publication in the new one, without delay."""
    subscription = shared.subscribe(OrbTest)
    task = in_thread(lambda: subscription.wait(20.0) and monotonic())
    task.thread.join(0.4)  # by now its looks are a second apart
    other = script(DEEP + "hear(); pub.publish(msg.OrbTest(val=3)); say('published'); hear()", 64)
    other.hear()
    assert not task.done()
    other.ask("go")
    published = monotonic()
    woken = task.result()
    assert isinstance(woken, float)
    assert woken - published < 0.5
    assert subscription.copy().val == 3


def test_publication_tells_the_queue_length_in_force(shared: uorb.Broker, script: Start) -> None:
    """A publisher sees that another process replaced its node before anybody published."""
    publication = shared.advertise(OrbTest)
    script(DEEP + "hear()", 9).hear()
    assert publication.queue_length == 9


@pytest.mark.parametrize("depth", [1, 4])
def test_samples_and_positions_survive(broker: uorb.Broker, depth: int) -> None:
    """Readable samples move along, whichever size comes next; readers go on where they were."""
    publication = broker.advertise(OrbTest, queue_length=depth)
    subscription = broker.subscribe(OrbTest)
    late = broker.subscribe(OrbTest)
    expected = 0
    for retained in (0, 60, 3, 500, 17, 0):
        for _ in range(7):
            publication.publish(OrbTest(val=expected))
            expected += 1
        move(broker, subscription, retained)
        kept = list(range(expected - depth, expected))
        assert values(subscription) == kept
        assert values(broker.subscribe(OrbTest, start="oldest")) == kept
        assert subscription.generation == expected == broker.topics()[0].generation
    assert values(late) == kept
    assert late.lost == expected - depth
    assert subscription.lost == 6 * (7 - depth)


def test_two_publishers_two_readers_one_mover(shared: uorb.Broker, script: Start) -> None:
    """The node is replaced all the time at random sizes: G is the sum, each publisher's samples stay in order."""
    writer = """
broker = uorb.Broker()
pub = broker.advertise("orb_test", queue_length=255)
say("ready"); hear()
for k in range(4000): pub.publish(msg.OrbTest(timestamp=int(sys.argv[1]), val=k))
say("done"); hear()
"""
    keeper = shared.advertise(OrbTest, queue_length=255)
    writers = [script(writer, n + 1) for n in range(2)]
    mover = script(MOVER + "say('ready'); hear()\nk = 0\nwhile True: k += 37; move(k % 600); time.sleep(0.004)")
    for one in (*writers, mover):
        one.hear()
    readers = [shared.subscribe(OrbTest) for _ in range(2)]
    mover.say("go")
    for one in writers:
        one.say("go")
    newest: dict[tuple[int, int], int] = {}
    counted = [0, 0]
    for _ in range(1 << 20):
        found = uorb.poll(readers, 20.0)
        assert found
        for reader in found:
            index = readers.index(reader)
            message, info = reader.copy_with_info()
            key = (index, message.timestamp)
            assert message.val > newest.get(key, -1)
            newest[key] = message.val
            counted[index] += 1
            assert info.generation == counted[index] + reader.lost
        if all(reader.generation == 8000 for reader in readers):
            break
    assert [one.hear() for one in writers] == ["done", "done"]
    assert keeper.queue_length == 255
    assert shared.topics()[0].generation == 8000
    assert mover.running()


KILLED = {
    "before the mark": "shared.format_node = die",
    "between mark and rename": "os.rename = die",
    "after the rename": "rename = os.rename\nos.rename = lambda *names: (rename(*names), die())",
}


@pytest.mark.parametrize("moment", KILLED)
@pytest.mark.parametrize("who", ["subscriber", "publisher"])
def test_a_mover_killed_in_the_act(
    shared: uorb.Broker, script: Start, in_thread: InThread, moment: str, who: str
) -> None:
    """Publisher and sleeper of other processes go on; nothing is lost; a later replacement works."""
    publication = shared.advertise(OrbTest, OrbTest(val=1), queue_length=4)
    subscription = shared.subscribe(OrbTest)
    subscription.copy()
    task = in_thread(lambda: subscription.wait(20.0))
    mover = script(
        MOVER
        + ("pub = broker.advertise('orb_test'); pub.publish(msg.OrbTest(val=2))\n" if who == "publisher" else "")
        + "from uorb_net.broker import shared\n"
        + "def die(*_): os.kill(os.getpid(), signal.SIGKILL)\n"
        + KILLED[moment]
        + "\nhear()\nmove(100)",
    )
    if who == "publisher":
        assert task.result() is True
        assert subscription.copy().val == 2
        task = in_thread(lambda: subscription.wait(20.0))
    mover.say("go")
    assert mover.ends() == -9
    started = monotonic()
    publication.publish(OrbTest(val=3))
    assert monotonic() - started < 0.5
    assert task.result() is True
    assert monotonic() - started < 2.0
    assert subscription.copy().val == 3
    assert not publication._node.mapping.words[W_G] & MOVED
    reader = script(
        "sub = uorb.Broker().subscribe('orb_test'); say(sub.copy().val); hear(); say(sub.copy().val); hear()"
    )
    assert reader.hear() == "3"
    publication.publish(OrbTest(val=4))
    assert reader.ask("go") == "4"
    assert subscription.copy().val == 4
    move(shared, subscription, 300)
    publication.publish(OrbTest(val=5))
    assert values(subscription) == [5]
    assert reader.running()
    assert not list(Path(shared.path).glob(".*.new"))


@pytest.mark.parametrize("moment", KILLED)
def test_a_mover_killed_while_nobody_publishes(shared: uorb.Broker, script: Start, moment: str) -> None:
    """A node found marked is repaired by whoever opens it next, and takes another queue length."""
    mover = script(
        MOVER
        + "from uorb_net.broker import shared\n"
        + "def die(*_): os.kill(os.getpid(), signal.SIGKILL)\n"
        + KILLED[moment]
        + "\nhear()\nmove(100)",
    )
    mover.say("go")
    assert mover.ends() == -9
    assert not shared.exists(OrbTest)
    assert not shared.topics()[0].advertised
    publication = shared.advertise(OrbTest, OrbTest(val=1), queue_length=3)
    assert publication.queue_length == 3
    assert shared.subscribe(OrbTest).copy().val == 1


def test_a_half_built_file_is_not_taken_over(shared: uorb.Broker) -> None:
    """Tables in a file that a killed builder left do not show in the node that is built next."""
    subscription = shared.subscribe(OrbTest)
    node = Path(shared.path, "orb_test")
    left = bytearray(node.read_bytes() + bytes(4096))
    left[512:4096] = b"\1" * (4096 - 512)
    subscription.close()
    node.unlink()
    Path(shared.path, ".orb_test.new").write_bytes(left)
    again = shared.subscribe(OrbTest)
    [status] = shared.topics()
    assert (status.publishers, status.subscribers, status.lost) == (0, 1, 0)
    assert not again._node.mapping.words[64]
    assert len(node.read_bytes()) == len(left) - 4096


def test_a_subscription_made_while_the_node_is_replaced(
    shared: uorb.Broker, monkeypatch: pytest.MonkeyPatch, script: Start
) -> None:
    """A replacement between opening a node and being entered in its table leaves no one in the old file."""
    enlist = members.enlist

    def late(node: Any, subscription: Any) -> None:
        monkeypatch.setattr(members, "enlist", enlist)
        script(DEEP + "pub.publish(msg.OrbTest(val=8)); hear()", 8).hear()
        enlist(node, subscription)

    monkeypatch.setattr(members, "enlist", late)
    subscription = shared.subscribe(OrbTest)
    assert subscription.wait(5.0)
    assert subscription.queue_length == 8
    assert subscription.copy().val == 8


def test_following_twice_never_takes_g_back(shared: uorb.Broker, monkeypatch: pytest.MonkeyPatch) -> None:
    """A thread that finds the node followed already leaves G alone: a publisher may be writing it."""
    publication = shared.advertise(OrbTest, OrbTest())
    node = publication._node
    find = shared._directory.find

    class Words:
        """G as another process would see it: every store by this one is a fault."""

        def __init__(self, words: Any) -> None:
            self.words = words

        def __getitem__(self, index: int) -> Any:
            return self.words[index]

        def __setitem__(self, index: int, value: int) -> None:
            raise AssertionError(f"word {index} was stored to")

    def found(topic: str, instance: int) -> Any:
        mapping = find(topic, instance)
        assert mapping is not None
        mapping.words = Words(mapping.words)  # type: ignore[assignment]
        return mapping

    monkeypatch.setattr(shared._directory, "find", found)
    node.recover()
    assert node.generation == 1


def test_a_stopped_publisher_refuses_the_mover(shared: uorb.Broker, script: Start) -> None:
    """A deeper wish while another process is stopped in its very first publication: BusyError, node unharmed."""
    other = script(
        """
pub = uorb.Broker().advertise("orb_test")
mapping = pub._node.mapping
pack = mapping.pack
def stopping(*fields):
    os.kill(os.getpid(), signal.SIGSTOP)
    pack(*fields)
mapping.pack = stopping
say("ready"); hear()
pub.publish(msg.OrbTest(val=1)); say("published"); hear()
"""
    )
    other.hear()
    subscription = shared.subscribe(OrbTest)
    other.say("go")
    other.await_stop()
    for publishers in (1, 2):  # alone, and among others who have not written yet
        with pytest.raises(uorb.BusyError):
            shared.advertise(OrbTest, queue_length=30)
        assert shared.topics()[0].publishers == publishers
        shared.advertise(OrbTest)
    other.signal(signal.SIGCONT)
    assert other.hear() == "published"
    assert subscription.copy().val == 1
    assert shared.topics()[0].publishers == 3
    assert shared.advertise(OrbTest, queue_length=30).queue_length == 1


def test_a_signal_handler_that_publishes_during_a_replacement(shared: uorb.Broker, script: Start) -> None:
    """Its sample comes after the replacement, in the new file; other processes follow."""
    subscription = shared.subscribe(OrbTest)
    mover = script(
        MOVER
        + """
pub = broker.advertise("orb_test")
k = 0
def handler(*_):
    global k
    k += 1
    pub.publish(msg.OrbTest(val=k))
signal.signal(signal.SIGALRM, handler)
copy, rename = growth._Copy.__call__, os.rename
def interrupted(self, mapping):
    os.kill(os.getpid(), signal.SIGALRM)
    copy(self, mapping)
    os.kill(os.getpid(), signal.SIGALRM)
def renaming(*names):
    os.kill(os.getpid(), signal.SIGALRM)
    rename(*names)
growth._Copy.__call__, os.rename = interrupted, renaming
for n in range(20):
    move(n * 20)
    say(k)
hear()
"""
    )
    for n in range(1, 21):
        assert mover.hear() == str(3 * n)
    assert subscription.copy().val == 60
    assert shared.topics()[0].generation == 60
