"""Forked children: nothing of the parent's works there, and nothing there holds up the parent or its heirs."""

from collections.abc import Callable
from time import monotonic
from typing import TYPE_CHECKING

import pytest

import uorb_net as uorb
from uorb_net.msg import OrbTest

if TYPE_CHECKING:
    from tests.conftest import Script

Start = Callable[..., "Script"]

CHILD = """
import warnings
warnings.simplefilter("ignore", DeprecationWarning)
def closed(call):
    try: call()
    except uorb.ClosedError: return True
    return False
"""


@pytest.mark.parametrize("kind", ["Broker()", "Broker.private()"])
def test_every_call_in_the_child_raises_and_the_parent_goes_on(script: Start, kind: str) -> None:
    """ClosedError from all that the parent opened, with several brokers too; closing there harms nobody."""
    parent = script(
        CHILD
        + f"""
brokers = [*(uorb.{kind} for _ in range(4)), uorb.Broker("other")]
pubs = [b.advertise("orb_test", msg.OrbTest(val=1)) for b in brokers]
subs = [b.subscribe("orb_test") for b in brokers]
for s in subs: s.copy(); s.wait(0.001)
def set_interval(): subs[0].interval = 1.0
read, write = os.pipe()
pid = os.fork()
if not pid:
    for broker, pub, sub in zip(brokers, pubs, subs):
        calls = [lambda: pub.publish(msg.OrbTest()), sub.check, sub.copy, sub.copy_with_info, sub.update,
            lambda: sub.wait(1), sub.stat, lambda: sub.pending, lambda: sub.advertised, lambda: uorb.poll([sub], 1),
            set_interval, lambda: broker.advertise("orb_test"), lambda: broker.subscribe("orb_test"),
            lambda: broker.exists("orb_test"), broker.topics, lambda: broker.group_count("orb_test"),
            lambda: broker.advertise_multi("orb_test"), sub.fileno]
        os.write(write, b"\\1" * sum(map(closed, calls)) + b"\\0" * (len(calls) - sum(map(closed, calls))))
        pub.unadvertise(); sub.close(); broker.close()
    sys.exit(0)
status = os.waitpid(pid, 0)[1]
os.close(write)
answers = os.read(read, 4096)
say(status, len(answers), answers.count(1))
for pub, sub in zip(pubs, subs):
    pub.publish(msg.OrbTest(val=2))
    say(sub.wait(1), sub.copy().val)
say(all(b.exists("orb_test") for b in brokers))
"""
    )
    assert parent.hear() == "0 90 90"
    assert [parent.hear() for _ in range(5)] == ["True 2"] * 5
    assert parent.hear() == "True"
    assert parent.ends() == 0


def test_a_child_opens_the_bus_anew(shared: uorb.Broker, script: Start) -> None:
    """A new Broker in the child is a process of its own on the bus: it publishes with the parent."""
    subscription = shared.subscribe(OrbTest)
    parent = script(
        CHILD
        + """
broker = uorb.Broker()
pub = broker.advertise("orb_test", msg.OrbTest(val=1))
ready, tell = os.pipe()
if not os.fork():
    own = uorb.Broker()
    mine = own.advertise("orb_test", msg.OrbTest(val=2))
    sub = own.subscribe("orb_test")
    assert sub.update().val == 2
    os.write(tell, b"r")
    while sub.wait(20) and sub.copy().val != 3: pass
    mine.publish(msg.OrbTest(val=4))
    os._exit(0)
os.read(ready, 1)
say(broker.topics()[0].publishers)
pub.publish(msg.OrbTest(val=3))
say(os.wait()[1])
hear()
"""
    )
    assert parent.hear() == "2"
    assert parent.hear() == "0"
    assert subscription.copy().val == 4
    assert subscription.lost == 3


def test_a_child_does_not_keep_its_dead_parent_alive(shared: uorb.Broker, script: Start) -> None:
    """The parent is killed, its child lives on: the parent's topic is gone at once."""
    parent = script(
        CHILD
        + """
brokers = [uorb.Broker(), uorb.Broker()]
pub = brokers[0].advertise("orb_test", msg.OrbTest(val=1))
read, write = os.pipe()
pid = os.fork()
if not pid:
    os.write(write, b"lives")
    time.sleep(60)
    os._exit(0)
os.read(read, 5)
say(pid); hear()
"""
    )
    child = int(parent.hear())
    try:
        assert shared.exists(OrbTest)
        parent.kill()
        assert not shared.exists(OrbTest)
        assert shared.topics()[0].publishers == 0
        with open(f"/proc/{child}/comm") as file:
            assert file.read()  # it does live
    finally:
        script(f"os.kill({child}, 9); say('killed')").hear()


def test_a_child_does_not_keep_its_dead_parents_write_lock(shared: uorb.Broker, script: Start) -> None:
    """The parent is killed in the middle of a shared write, its child lives on: others publish at once."""
    publication = shared.advertise(OrbTest)
    parent = script(
        CHILD
        + """
pub = uorb.Broker().advertise("orb_test")
pub.publish(msg.OrbTest(val=1))
read, write = os.pipe()
pid = os.fork()
if not pid:
    os.write(write, b"lives")
    time.sleep(60)
    os._exit(0)
os.read(read, 5)
mapping = pub._node.mapping
mapping.pack = lambda *_: os.kill(os.getpid(), signal.SIGKILL)
say(pid); hear()
pub.publish(msg.OrbTest(val=2))
"""
    )
    child = int(parent.hear())
    try:
        publication.publish(OrbTest(val=5))
        parent.say("go")
        assert parent.ends() == -9
        started = monotonic()
        publication.publish(OrbTest(val=6))
        assert monotonic() - started < 0.5
    finally:
        script(f"os.kill({child}, 9); say('killed')").hear()


def test_multiprocessing_by_fork(shared: uorb.Broker, script: Start) -> None:
    """A pool of forked workers, each with a Broker of its own, beside a parent that publishes."""
    parent = script(
        CHILD
        + """
import multiprocessing
broker = uorb.Broker()
pub = broker.advertise("orb_test_medium")
def work(n):
    with uorb.Broker() as own, own.advertise_multi("orb_multitest") as mine:
        mine.publish(msg.OrbTest(val=n))
        return mine.instance, own.exists("orb_test_medium")
with multiprocessing.get_context("fork").Pool(3) as pool:
    found = pool.map(work, range(12), chunksize=4)
pub.publish(msg.OrbTestMedium())
say(len(found), all(there for _, there in found), max(instance for instance, _ in found) < 3)
"""
    )
    assert parent.hear() == "12 True True"
    assert shared.group_count("orb_multitest") == 0
