"""No wake-up is lost: ping-pong between two processes, counting the sleeps that ended without one."""

import os
from collections.abc import Callable
from pathlib import Path
from time import monotonic
from typing import TYPE_CHECKING, Any

import pytest

import uorb_net as uorb
from uorb_net.broker.waking import Sleeper
from uorb_net.msg import OrbTest

if TYPE_CHECKING:
    from tests.conftest import Script

Start = Callable[..., "Script"]
ROUNDS = int(os.environ.get("UORB_WAKEUP_ROUNDS", "100000"))

ECHO = """
broker = uorb.Broker()
sub = broker.subscribe("orb_test")
others = [broker.subscribe("orb_test_medium"), broker.subscribe("orb_test_large")]
pub = broker.advertise("orb_multitest")
from uorb_net.broker.waking import Sleeper
looks = 0
sleep = Sleeper.sleep
def counting(self, seconds):
    global looks
    before = time.monotonic()
    woken = sleep(self, seconds)
    looks += not woken and sub.check() and sub.stat() / 1e6 < before + seconds - 0.001
    return woken
Sleeper.sleep = counting
say("ready")
for _ in range(int(sys.argv[1])):
    assert sub.wait(20) if sys.argv[2] == "wait" else uorb.poll([*others, sub], 20)
    pub.publish(msg.OrbTest(val=sub.copy().val))
say(looks)
hear()
"""


@pytest.mark.timeout(600 if ROUNDS > 10_000 else 60)
@pytest.mark.parametrize("kind", ["wait", "poll"])
def test_ping_pong(shared: uorb.Broker, script: Start, monkeypatch: pytest.MonkeyPatch, kind: str) -> None:
    """No round longer than 1.2 s, and fewer than one in a thousand ended by a look of the sleeper's own.

    A look also ends a sleep where the other process had no processor to answer in time: those do not count.
    """
    rounds = ROUNDS if kind == "wait" else ROUNDS // 4
    echo = script(ECHO, rounds, kind)
    subscription = shared.subscribe("orb_multitest")
    publication = shared.advertise(OrbTest)
    echo.hear()
    late = 0
    sleep = Sleeper.sleep

    def counting(self: Sleeper, seconds: float) -> bool:
        nonlocal late
        before = monotonic()
        woken = sleep(self, seconds)
        # A wake-up was lost where the sleep ran to its end though the answer had come well before.
        late += not woken and subscription.check() and subscription.stat() / 1e6 < before + seconds - 0.001
        return woken

    monkeypatch.setattr(Sleeper, "sleep", counting)
    longest = 0.0
    for value in range(rounds):
        started = monotonic()
        publication.publish(OrbTest(val=value))
        assert subscription.wait(20.0), f"round {value} got no answer"
        longest = max(longest, monotonic() - started)
        assert subscription.copy().val == value
    assert longest < 1.2
    assert late + int(echo.hear()) < max(rounds / 1000, 3)


def test_a_wait_finds_a_sample_whose_wake_up_never_came(shared: uorb.Broker, script: Start) -> None:
    """A publisher killed between the sample and the wake-up delays its readers by a second at most."""
    reader = script("sub = uorb.Broker().subscribe('orb_test'); say('ready'); sub.wait(20); say(sub.copy().val)")
    keeper = shared.advertise(OrbTest)
    reader.hear()
    writer = script(
        """
from uorb_net.broker import node
node.wake = lambda *_: os.kill(os.getpid(), signal.SIGKILL)
pub = uorb.Broker().advertise("orb_test")
time.sleep(0.4)  # the reader's looks are far apart by now
pub.publish(msg.OrbTest(val=7))
"""
    )
    assert writer.ends() == -9
    started = monotonic()
    assert reader.hear() == "7"
    assert monotonic() - started < 2.0
    del keeper


@pytest.mark.parametrize("how", ["wait", "poll"])
def test_a_wake_up_races_with_arming(shared: uorb.Broker, monkeypatch: pytest.MonkeyPatch, how: str) -> None:
    """A publication at any step of a sleeper's arming is found at once, or wakes it."""
    quiet = shared.subscribe("orb_test_medium")
    publication = shared.advertise(OrbTest)
    subscription = shared.subscribe(OrbTest)

    def wait() -> object:
        return subscription.wait(5.0) if how == "wait" else uorb.poll([subscription, quiet], 5.0)

    directory = type(shared._directory)
    arm, sleep = directory.arm, Sleeper.sleep
    looks: list[bool] = []

    def counting(self: Sleeper, seconds: float) -> bool:
        looks.append(sleep(self, seconds))
        return looks[-1]

    def before(self: Any, words: Any, number: int) -> bool:
        publication.publish(OrbTest())
        return arm(self, words, number)

    def after(self: Any, words: Any, number: int) -> bool:
        armed = arm(self, words, number)
        publication.publish(OrbTest())
        return armed

    monkeypatch.setattr(Sleeper, "sleep", counting)
    for racing in (before, after):
        monkeypatch.setattr(directory, "arm", racing)
        assert wait()
        subscription.copy()
    assert looks == []  # never slept

    def in_between(self: Sleeper, seconds: float) -> bool:
        publication.publish(OrbTest())
        return counting(self, seconds)

    monkeypatch.setattr(directory, "arm", arm)
    monkeypatch.setattr(Sleeper, "sleep", in_between)
    for _ in range(100):
        assert wait()
        subscription.copy()
    assert looks == [True] * 100


def test_a_sleeper_found_dead_by_two_threads(shared: uorb.Broker, monkeypatch: pytest.MonkeyPatch) -> None:
    """The second finds its descriptor gone, and goes on."""
    directory = shared._directory
    monkeypatch.setattr(directory, "open_end", lambda number: True)
    directory.poke(12345)
    assert directory.fds.get(12345) is None


def test_a_fifo_full_of_wake_ups_blocks_nobody(shared: uorb.Broker, script: Start) -> None:
    """A stopped sleeper's FIFO may fill up: publishing goes on, and it wakes when it goes on."""
    reader = script(READER_OF_MANY)
    publications = [shared.advertise("orb_test"), shared.advertise("orb_multitest")]
    assert reader.hear() == "ready"
    directory = shared._directory
    assert reader.hear() == "armed"
    reader.stop()
    [number] = [int(path.name[2:]) for path in Path(shared.path).glob(".w*")]
    while directory.open_end(number):
        try:
            os.write(directory.fds[number], bytes(4096))
        except BlockingIOError:
            break
    started = monotonic()
    for publication in publications:
        publication.publish(OrbTest(val=3))
    assert monotonic() - started < 0.5
    reader.signal(18)
    assert reader.hear() == "3"


READER_OF_MANY = """
broker = uorb.Broker()
subs = [broker.subscribe("orb_test"), broker.subscribe("orb_multitest")]
uorb.poll(subs, 0.01)
say("ready")
threading.Timer(0.1, lambda: say("armed")).start()
found = uorb.poll(subs, 20)
say(found[0].copy().val)
hear()
"""
