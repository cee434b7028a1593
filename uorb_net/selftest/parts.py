"""The parts of the self test, as PX4's uORBTest_UnitTest has them, each on a bus of its own.

A part raises `Failed` with what was wrong, or returns a remark. Those that need a second process start
it by name: `run_publisher` is the other end of "poll" and "latency".
"""

from collections.abc import Callable
from statistics import median
from time import monotonic, sleep
from typing import Any

from ..clock import hrt_absolute_time
from ..errors import NoDataError, UorbError
from ..msg import OrbTest, OrbTestMedium
from ..orb import (
    ORB_ID,
    ORB_PRIO_MAX,
    ORB_PRIO_MIN,
    default_broker,
    orb_advertise,
    orb_advertise_multi,
    orb_advertise_queue,
    orb_check,
    orb_copy,
    orb_exists,
    orb_group_count,
    orb_priority,
    orb_publish,
    orb_set_interval,
    orb_subscribe,
    orb_subscribe_multi,
    orb_unadvertise,
    orb_unsubscribe,
    px4_poll,
    px4_pollfd,
)

QUEUE = 16
POLLED = 200  # samples of the part "poll"
ROUNDS = 2000  # of the part "latency"

Spawn = Callable[[str], object]


class Failed(Exception):  # noqa: N818 - a finding of the test, not an error of the bus
    """What a part found wrong."""


def expect(condition: object, text: str) -> None:
    """Raise `Failed` unless the condition holds."""
    if not condition:
        raise Failed(text)


def single(spawn: Spawn) -> str:
    """One publisher, one subscriber: no spurious update, the data, one update per publication."""
    meta = ORB_ID("orb_test")
    sub = orb_subscribe(meta)
    try:
        orb_copy(meta, sub)
    except NoDataError:
        pass
    else:
        raise Failed("a copy worked before anything was advertised")
    pub = orb_advertise(meta, OrbTest(val=0))
    expect(orb_check(sub), "no update after the advertisement's data")
    expect(orb_copy(meta, sub).val == 0, "the first copy is not what was published")
    expect(not orb_check(sub), "a spurious update after the copy")
    orb_publish(meta, pub, OrbTest(val=2))
    expect(orb_check(sub), "no update after a publication")
    expect(orb_copy(meta, sub).val == 2, "the second copy is not what was published")
    orb_unsubscribe(sub)
    orb_unadvertise(pub)
    return ""


def multi(spawn: Spawn) -> str:
    """Two instances: own data, own priority, own updates."""
    return _two_instances([0, 1])


def multi_reversed(spawn: Spawn) -> str:
    """The same with the subscribers made first, in reverse order."""
    return _two_instances([1, 0])


def _two_instances(order: list[int]) -> str:
    meta = ORB_ID("orb_multitest")
    subs: dict[int, Any] = {}
    reverse = order[0] == 1
    if reverse:
        subs = {i: orb_subscribe_multi(meta, i) for i in order}
    priorities = (ORB_PRIO_MAX, ORB_PRIO_MIN)
    pubs = [orb_advertise_multi(meta, OrbTest(val=100 * i + 3), priorities[i]) for i in range(2)]
    expect([pub.instance for pub in pubs] == [0, 1], "the instances are not 0 and 1")
    if not reverse:
        subs = {i: orb_subscribe_multi(meta, i) for i in order}
    for i in range(2):
        expect(orb_copy(meta, subs[i]).val == 100 * i + 3, f"instance {i} has another one's data")
        expect(orb_priority(subs[i]) == priorities[i], f"instance {i} has another priority")
    orb_publish(meta, pubs[1], OrbTest(val=7))
    expect(not orb_check(subs[0]), "a publication on instance 1 updated instance 0")
    expect(orb_copy(meta, subs[1]).val == 7, "instance 1 did not get its sample")
    return f"{orb_group_count(meta)} instances"


def unadvertise(spawn: Spawn) -> str:
    """Going and coming of publishers: existence, lowest free number, no old sample."""
    meta = ORB_ID("orb_multitest")
    pubs = [orb_advertise_multi(meta, OrbTest(val=i)) for i in range(4)]
    subs = [orb_subscribe_multi(meta, i) for i in range(4)]
    orb_unadvertise(pubs[1])
    expect(not orb_exists(meta, 1), "an unadvertised instance still exists")
    expect(orb_group_count(meta) == 3, "the group count hides what lies behind a hole")
    expect(not orb_check(subs[1]), "an unadvertised instance has an update")
    pubs[1] = orb_advertise_multi(meta, None)
    expect(pubs[1].instance == 1, "the freed number was not taken")
    expect(not orb_check(subs[1]), "the former publisher's sample came back")
    orb_publish(meta, pubs[1], OrbTest(val=9))
    expect(orb_copy(meta, subs[1]).val == 9, "the new publisher's sample did not arrive")
    return ""


def queue(spawn: Spawn) -> str:
    """A queue in order, overflowing, and read more often than it was written."""
    meta = ORB_ID("orb_test_medium_queue")
    pub = orb_advertise_queue(meta, None, QUEUE)
    sub = orb_subscribe(meta)
    for number in range(QUEUE - 3):
        orb_publish(meta, pub, OrbTestMedium(val=number))
    _read(meta, sub, range(QUEUE - 3), "in order")
    for number in range(2 * QUEUE):
        orb_publish(meta, pub, OrbTestMedium(val=number))
    _read(meta, sub, range(QUEUE, 2 * QUEUE), "after an overflow")
    expect(not orb_check(sub), "an update when everything was read")
    expect(orb_copy(meta, sub).val == 2 * QUEUE - 1, "an emptied queue does not repeat its newest")
    expect(sub.lost == QUEUE, f"{sub.lost} counted as lost, {QUEUE} were")
    return f"{QUEUE} deep"


def _read(meta: Any, sub: Any, wanted: range, when: str) -> None:
    for number in wanted:
        expect(orb_check(sub), f"no update for sample {number} {when}")
        got = orb_copy(meta, sub).val
        expect(got == number, f"sample {got} where {number} was due {when}")


def poll(spawn: Spawn) -> str:
    """A queue filled by another process and read through poll: complete and in order."""
    meta = ORB_ID("orb_test_medium_queue_poll")
    sub = orb_subscribe(meta)
    spawn("poll")
    fds = [px4_pollfd(sub)]
    for number in range(POLLED):
        while not orb_check(sub):
            expect(px4_poll(fds, 3000) == 1, f"no sample within 3 s, {number} came")
        got = orb_copy(meta, sub).val
        expect(got == number, f"sample {got} where {number} was due")
    return f"{POLLED} samples from another process"


def interval(spawn: Spawn) -> str:
    """A limited subscription: at most once per interval, and the last sample of a burst when it is due."""
    meta = ORB_ID("orb_test")
    sub = orb_subscribe(meta)
    orb_set_interval(sub, 50)
    pub = orb_advertise(meta, None)
    began, got = monotonic(), 0
    number = 0
    while monotonic() - began < 0.5:
        orb_publish(meta, pub, OrbTest(val=number))
        number += 1
        if orb_check(sub):
            orb_copy(meta, sub)
            got += 1
        sleep(0.002)
    expect(8 <= got <= 12, f"{got} updates in 0.5 s at an interval of 50 ms")
    orb_publish(meta, pub, OrbTest(val=-1))
    expect(px4_poll([px4_pollfd(sub)], 1000) == 1, "what the interval held back did not wake the poll")
    expect(orb_copy(meta, sub).val == -1, "the last sample of the burst did not arrive")
    return f"{number} publications, {got} updates"


def latency(spawn: Spawn) -> str:
    """Round trips with another process: none lost, and how long they take."""
    ping, pong = ORB_ID("orb_test"), ORB_ID("orb_test_medium")
    sub = orb_subscribe(pong)
    pub = orb_advertise(ping, None)
    spawn("latency")
    expect(px4_poll([px4_pollfd(sub)], 5000) == 1, "the other process did not come up")
    orb_copy(pong, sub)
    times = []
    for number in range(ROUNDS):
        before = hrt_absolute_time()
        orb_publish(ping, pub, OrbTest(val=number))
        expect(px4_poll([px4_pollfd(sub)], 2000) == 1, f"no answer in round {number}")
        expect(orb_copy(pong, sub).val == number, f"another answer than {number}")
        times.append(hrt_absolute_time() - before)
    return f"round trip {median(times):.0f} us, at most {max(times)} us"


def run_publisher(part: str) -> None:
    """Be the second process of a part."""
    if part == "poll":
        meta = ORB_ID("orb_test_medium_queue_poll")
        with default_broker().advertise(meta, queue_length=QUEUE) as pub:
            for number in range(POLLED):
                pub.publish(OrbTestMedium(val=number))
                sleep(0.001)
            sleep(1.0)  # the reader empties the queue while the topic is still advertised
        return
    ping, pong = ORB_ID("orb_test"), ORB_ID("orb_test_medium")
    sub = orb_subscribe(ping)
    out = orb_advertise(pong, OrbTestMedium(val=-1))
    for _ in range(ROUNDS):
        if px4_poll([px4_pollfd(sub)], 5000) != 1:
            raise UorbError("no ping within 5 s")
        orb_publish(pong, out, OrbTestMedium(val=orb_copy(ping, sub).val))
    sleep(0.5)  # the last answer is read while the topic is still advertised


PARTS: dict[str, Callable[[Spawn], str]] = {
    "single": single,
    "multi": multi,
    "multi reversed": multi_reversed,
    "unadvertise": unadvertise,
    "queue": queue,
    "queue with poll": poll,
    "interval": interval,
    "latency": latency,
}
