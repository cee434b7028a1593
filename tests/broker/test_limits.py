"""The limits: publishing processes, subscribing processes, sleepers, instances, descriptors, names, sizes."""

import errno
import resource
from collections.abc import Callable
from time import monotonic
from typing import TYPE_CHECKING

import pytest

import uorb_net as uorb
from uorb_net import messages
from uorb_net.broker.layout import (
    PUBLISHERS,
    PUBLISHERS_MAX,
    SLEEPERS,
    SLEEPERS_MAX,
    SUBSCRIBERS,
    SUBSCRIBERS_MAX,
    W_SLEEPERS,
)
from uorb_net.broker.tables import Share
from uorb_net.msg import OrbTest

if TYPE_CHECKING:
    from tests.conftest import Script

Start = Callable[..., "Script"]


def living(script: Start) -> "tuple[Script, int]":
    """Return another process on the bus and its number."""
    other = script("say(uorb.Broker()._directory.me); hear()")
    return other, int(other.hear())


def test_the_33rd_publishing_process(shared: uorb.Broker, script: Start) -> None:
    """BusError (ENOSPC) that names the topic; those there are untouched; a death makes room."""
    other, number = living(script)
    publication = shared.advertise(OrbTest, OrbTest(val=1))
    words = publication._node.mapping.words
    for place in range(1, PUBLISHERS_MAX):
        words[PUBLISHERS + 2 * place + 1] = Share(0, number, 1, 75, place, own=False).pack()
        words[PUBLISHERS + 2 * place] = number
    newcomer = script(
        """
broker = uorb.Broker()
for call in (lambda: broker.advertise("orb_test"), lambda: broker.advertise("orb_test", queue_length=9)):
    try: call()
    except uorb.BusError as error: text, number = str(error), error.errno
say(number, len(broker._directory.nodes), text); hear()
broker.advertise("orb_test", msg.OrbTest(val=2)); say("advertised"); hear()
"""
    )
    code, nodes, text = newcomer.hear().split(maxsplit=2)
    assert (int(code), int(nodes)) == (errno.ENOSPC, 0)
    assert "orb_test" in text
    assert str(PUBLISHERS_MAX) in text
    assert shared.topics()[0].publishers == PUBLISHERS_MAX
    other.kill()
    assert shared.topics()[0].publishers == 1
    assert newcomer.ask("again") == "advertised"
    assert shared.topics()[0].publishers == 2
    assert shared.subscribe(OrbTest).copy().val == 2


def test_the_65th_subscribing_process(shared: uorb.Broker, script: Start) -> None:
    """BusError (ENOSPC); nothing is left of the attempt; a death makes room."""
    other, number = living(script)
    keeper = shared.subscribe(OrbTest)
    words = keeper._node.mapping.words
    for place in range(1, SUBSCRIBERS_MAX):
        words[SUBSCRIBERS + 4 * place + 1] = 1
        words[SUBSCRIBERS + 4 * place] = number
    newcomer = script(
        """
broker = uorb.Broker()
try: broker.subscribe("orb_test")
except uorb.BusError as error: say(error.errno, len(broker._directory.nodes), str(error))
hear(); broker.subscribe("orb_test"); say("subscribed"); hear()
"""
    )
    code, nodes, text = newcomer.hear().split(maxsplit=2)
    assert (int(code), int(nodes)) == (errno.ENOSPC, 0)
    assert str(SUBSCRIBERS_MAX) in text
    assert shared.topics()[0].subscribers == SUBSCRIBERS_MAX
    other.kill()
    assert newcomer.ask("again") == "subscribed"
    assert shared.topics()[0].subscribers == 2


def test_the_65th_sleeper(shared: uorb.Broker, script: Start) -> None:
    """It has no place in the table and looks every 5 ms instead: late by little, and idle in between."""
    publication = shared.advertise(OrbTest)
    words = publication._node.mapping.words
    for place in range(SLEEPERS_MAX):
        words[SLEEPERS + 2 * place] = shared._directory.new_end().number
    words[W_SLEEPERS] = SLEEPERS_MAX
    for how in ("sub.wait(20)", "uorb.poll([other, sub], 20)"):
        reader = script(
            f"""
import resource
broker = uorb.Broker()
other, sub = broker.subscribe("orb_multitest"), broker.subscribe("orb_test", start="new")
say("ready")
assert {how}
say(time.monotonic(), time.process_time(), sub.copy().val)
"""
        )
        assert reader.hear() == "ready"
        reader_is_asleep = monotonic() + 0.3
        while monotonic() < reader_is_asleep:
            assert not shared.subscribe(OrbTest, start="new").wait(0.05)
        published = monotonic()
        publication.publish(OrbTest(val=9))
        woken, used, value = reader.hear().split()
        assert value == "9"
        assert float(woken) - published < 0.2
        assert float(used) < 0.5  # the import, mostly
        assert reader.ends() == 0


def test_dead_sleepers_make_room(shared: uorb.Broker, script: Start) -> None:
    """A full table whose owners are dead is no full table."""
    dead = script("d = uorb.Broker()._directory; say(*[d.new_end().number for _ in range(64)]); hear()")
    numbers = [int(text) for text in dead.hear().split()]
    publication = shared.advertise(OrbTest)
    words = publication._node.mapping.words
    for place, number in enumerate(numbers):
        words[SLEEPERS + 2 * place] = number
    words[W_SLEEPERS] = SLEEPERS_MAX
    dead.kill()
    reader = script("sub = uorb.Broker().subscribe('orb_test'); say('ready'); sub.wait(20); say(sub.copy().val)")
    reader.hear()
    while not set(words[SLEEPERS : SLEEPERS + 2 * SLEEPERS_MAX : 2]) - set(numbers):
        assert reader.running()
    publication.publish(OrbTest(val=4))
    assert reader.hear() == "4"


def test_three_hundred_nodes_raise_the_soft_limit(shared: uorb.Broker, script: Start) -> None:
    """A mapped node costs a descriptor: the soft limit goes up to the hard one, and all works."""
    hard = resource.getrlimit(resource.RLIMIT_NOFILE)[1]
    if hard < 1000:
        pytest.skip(f"the hard limit of descriptors is {hard} here, 1000 are needed")
    many = script(
        """
hear()
broker = uorb.Broker()
cls = uorb.messages.from_text("ManyTopic", "uint64 timestamp\\nint32 val\\n")
pubs = [broker.advertise_instance(cls, "many_topic_%d" % n, 0) for n in range(300)]
for n, pub in enumerate(pubs): pub.publish(cls(val=n))
say("advertised")
subs = [broker.subscribe("many_topic_%d" % n) for n in range(300)]
say(sum(sub.copy().val for sub in subs), len(uorb.poll([broker.subscribe("orb_test"), subs[0]], 0.01)))
say(broker.exists("many_topic_299"), len(broker.topics()))
hear()
"""
    )
    resource.prlimit(many.pid, resource.RLIMIT_NOFILE, (64, hard))
    assert many.ask("go") == "advertised"
    assert resource.prlimit(many.pid, resource.RLIMIT_NOFILE)[0] == hard
    assert many.hear() == f"{sum(range(300))} 0"
    assert many.hear() == "True 301"
    started = monotonic()
    statuses = shared.topics()
    assert monotonic() - started < 1.0
    assert len(statuses) == 301
    assert sum(status.publishers for status in statuses) == 300


def test_at_the_hard_limit(shared: uorb.Broker, script: Start) -> None:
    """No descriptor left and none to be had: BusError (EMFILE), and what is open works on."""
    shared.advertise("orb_test_medium")
    few = script(
        """
import resource
types = msg.OrbTest, msg.OrbTestMedium, msg.OrbTestLarge
broker = uorb.Broker()
pub, sub = broker.advertise("orb_test"), broker.subscribe("orb_test")
resource.setrlimit(resource.RLIMIT_NOFILE, (32, 32))
held = []
try:
    while True: held.append(os.open("/dev/null", os.O_RDONLY))
except OSError: pass
for call in (lambda: broker.advertise("orb_multitest"), lambda: broker.subscribe("orb_test_large"),
        lambda: sub.wait(0.1), lambda: uorb.Broker("another"), lambda: broker.exists("orb_test_medium")):
    try: call(); say("no error")
    except uorb.BusError as error: say(error.errno)
    except BaseException as error: say(repr(error))
pub.publish(msg.OrbTest(val=3))
say(sub.copy().val)
for fd in held: os.close(fd)
broker.advertise("orb_multitest", msg.OrbTest(val=4))
say(broker.subscribe("orb_multitest").copy().val, sub.wait(0.01))
hear()
"""
    )
    assert [few.hear() for _ in range(5)] == [str(errno.EMFILE)] * 5
    assert few.hear() == "3"
    assert few.hear() == "4 False"


@pytest.mark.parametrize("kind", ["shared", "private"])
@pytest.mark.parametrize("how", ["wait", "fileno"])
def test_the_soft_limit_met_while_waiting(script: Start, kind: str, how: str) -> None:
    """A wait that needs descriptors at the soft limit raises it, as opening nodes does."""
    waiting = script(
        """
import resource, uorb_net.exported
broker = uorb.Broker()
sub, pub = broker.subscribe("orb_test"), broker.advertise("orb_test")
hard = resource.getrlimit(resource.RLIMIT_NOFILE)[1]
resource.setrlimit(resource.RLIMIT_NOFILE, (32, hard))
try:
    while True: os.open("/dev/null", os.O_RDONLY)
except OSError: pass
if sys.argv[1] == "private": broker = uorb.Broker.private(); sub = broker.subscribe("orb_test")
say(sub.wait(0.01) if sys.argv[2] == "wait" else sub.fileno() > 0)
hear()
""",
        kind,
        how,
    )
    assert waiting.hear() == str(how == "fileno")


def test_large_samples_and_long_queues(broker: uorb.Broker) -> None:
    """A megabyte per sample works, in a queue of three."""
    cls = messages.from_text("HugeTopic", "uint64 timestamp\nuint8[1000000] data\n# TOPICS huge_topic")
    publication = broker.advertise(cls, queue_length=3)
    subscription = broker.subscribe(cls)
    for value in range(5):
        publication.publish(cls(data=bytes([value]) * 1_000_000))
    read = [message.data for message in iter(subscription.update, None)]  # type: ignore[attr-defined]
    assert read == [bytes([value]) * 1_000_000 for value in (2, 3, 4)]
    assert subscription.lost == 2


def test_the_smallest_sample(broker: uorb.Broker) -> None:
    """A message of nothing but its timestamp."""
    cls = messages.from_text("TinyTopic", "uint64 timestamp\n# TOPICS tiny_topic")
    broker.advertise(cls, cls(timestamp=5))
    assert broker.subscribe(cls).copy() == cls(timestamp=5)


def test_many_publications_of_one_process(broker: uorb.Broker) -> None:
    """Three hundred publications on one node are counted one by one, and do not disturb its priority."""
    publications = [broker.advertise(OrbTest) for _ in range(300)]
    [status] = broker.topics()
    assert (status.publishers, status.priority) == (300, 75)
    for number, publication in enumerate(publications):
        publication.publish(OrbTest(val=number))
    for publication in publications[1:]:
        publication.unadvertise()
    assert broker.topics()[0].publishers == 1
    assert broker.topics()[0].generation == 300
