"""The guide's functions, and its own example applications translated line by line."""

import errno
from collections.abc import Callable, Iterator
from pathlib import Path
from random import Random
from threading import Thread
from time import monotonic
from typing import Any

import pytest

import uorb_net as uorb
from uorb_net import messages
from uorb_net.msg import OrbTest, SensorCombined, VehicleAttitude
from uorb_net.orb import (
    ORB_ID,
    ORB_PRIO_DEFAULT,
    ORB_PRIO_MAX,
    ORB_PRIO_MIN,
    POLLIN,
    default_broker,
    orb_advertise,
    orb_advertise_multi,
    orb_advertise_multi_queue,
    orb_advertise_queue,
    orb_check,
    orb_copy,
    orb_exists,
    orb_get_interval,
    orb_group_count,
    orb_priority,
    orb_publish,
    orb_publish_auto,
    orb_set_interval,
    orb_stat,
    orb_subscribe,
    orb_subscribe_multi,
    orb_unadvertise,
    orb_unsubscribe,
    px4_poll,
    px4_pollfd,
    set_default_broker,
)


@pytest.fixture(autouse=True)
def bus() -> Iterator[uorb.Broker]:
    """A private bus as the default broker."""
    with uorb.Broker.private() as broker:
        set_default_broker(broker)
        yield broker


def fails(code: int, call: Callable[..., Any], *arguments: Any) -> None:
    """Check that a call raises with uORB's errno."""
    with pytest.raises(uorb.UorbError) as caught:
        call(*arguments)
    assert caught.value.errno == code


@pytest.fixture
def random_integer(tmp_path: Path) -> Any:
    """The guide's topic of one's own: a .msg file in a folder is all it takes."""
    (tmp_path / "random_integer.msg").write_text("int32 r\n")
    messages.add_path(tmp_path)
    return messages.load("RandomInteger")


def test_random_integer(random_integer: Any) -> None:
    """The guide's own topic: init, update_topic, check_topic."""
    random = Random(1)
    topic_handle = orb_advertise(ORB_ID("random_integer"), random_integer(r=random.randrange(100)))
    subscriber = orb_subscribe(ORB_ID("random_integer"))
    printed = []

    def update_topic() -> None:
        rd = random_integer(r=random.randrange(100))
        orb_publish(ORB_ID("random_integer"), topic_handle, rd)

    def check_topic() -> None:
        updated = orb_check(subscriber)
        if updated:
            rd = orb_copy(ORB_ID("random_integer"), subscriber)
            printed.append(f"Random integer is now {rd.r}")

    check_topic()
    assert printed == []
    for _ in range(3):
        update_topic()
        check_topic()
    check_topic()
    assert len(printed) == 3


def test_px4_simple_app_with_its_error_counter(bus: uorb.Broker) -> None:
    """The guide's poll loop: data, silence, a poll that fails."""
    sensor_sub_fd = orb_subscribe(ORB_ID("sensor_combined"))
    fds = [px4_pollfd(fd=sensor_sub_fd, events=POLLIN)]
    error_counter = 0
    lines = []

    def turn(timeout_ms: int) -> None:
        nonlocal error_counter
        try:
            poll_ret = px4_poll(fds, timeout_ms)
        except uorb.UorbError as error:
            if error_counter < 10 or error_counter % 50 == 0:
                lines.append(f"[px4_simple_app] ERROR return value from poll(): {error.errno}")
            error_counter += 1
            return
        if poll_ret == 0:
            lines.append("[px4_simple_app] Got no data within a second")
        elif fds[0].revents & POLLIN:
            raw = orb_copy(ORB_ID("sensor_combined"), sensor_sub_fd)
            lines.append("[px4_simple_app] Accelerometer:\t{:8.4f}\t{:8.4f}\t{:8.4f}".format(*raw.accelerometer_m_s2))

    turn(10)
    pub = orb_advertise(ORB_ID("sensor_combined"), SensorCombined(accelerometer_m_s2=(1.0, 2.0, -9.8125)))
    turn(1000)
    orb_publish(ORB_ID("sensor_combined"), pub, SensorCombined(accelerometer_m_s2=(0.5, 0.0, 0.0)))
    turn(1000)
    orb_unsubscribe(sensor_sub_fd)
    for _ in range(70):
        turn(10)
    assert lines[:3] == [
        "[px4_simple_app] Got no data within a second",
        "[px4_simple_app] Accelerometer:\t  1.0000\t  2.0000\t -9.8125",
        "[px4_simple_app] Accelerometer:\t  0.5000\t  0.0000\t  0.0000",
    ]
    assert len(lines) == 3 + 11
    assert error_counter == 70


def test_subscribe_and_republish_at_an_interval() -> None:
    """The guide's second application: sensor_combined in at most once per interval, vehicle_attitude out."""
    sensor_sub_fd = orb_subscribe(ORB_ID("sensor_combined"))
    orb_set_interval(sensor_sub_fd, 100)
    assert orb_get_interval(sensor_sub_fd) == 100
    att_pub_fd = orb_advertise(ORB_ID("vehicle_attitude"), VehicleAttitude())
    attitudes = orb_subscribe(ORB_ID("vehicle_attitude"))
    sensors = orb_advertise(ORB_ID("sensor_combined"), None)
    stop = False

    def drive() -> None:
        while not stop:
            orb_publish(ORB_ID("sensor_combined"), sensors, SensorCombined(gyro_rad=(0.25, 0.0, 0.0)))
            px4_poll([px4_pollfd(attitudes, events=0)], 5)  # sleeps 5 ms

    driver = Thread(target=drive)
    driver.start()
    fds = [px4_pollfd(fd=sensor_sub_fd, events=POLLIN)]
    began, turns = monotonic(), 0
    while monotonic() - began < 0.65:
        if px4_poll(fds, 1000) > 0 and fds[0].revents & POLLIN:
            raw = orb_copy(ORB_ID("sensor_combined"), sensor_sub_fd)
            orb_publish(ORB_ID("vehicle_attitude"), att_pub_fd, VehicleAttitude(q=(raw.gyro_rad[0], 0.0, 0.0, 0.0)))
            turns += 1
    stop = True
    driver.join()
    assert 5 <= turns <= 9
    assert orb_check(attitudes)
    assert orb_copy(ORB_ID("vehicle_attitude"), attitudes).q[0] == 0.25


def test_advertise_multi_with_priorities() -> None:
    """Two instances, each with its own data and priority; the guide's orb_multitest."""
    meta = ORB_ID("orb_multitest")
    pfd0 = orb_advertise_multi(meta, OrbTest(val=103), ORB_PRIO_MAX)
    pfd1 = orb_advertise_multi(meta, OrbTest(val=203), ORB_PRIO_MIN)
    assert (pfd0.instance, pfd1.instance) == (0, 1)
    sfd0, sfd1 = orb_subscribe_multi(meta, 0), orb_subscribe_multi(meta, 1)
    assert orb_copy(meta, sfd0).val == 103
    assert orb_copy(meta, sfd1).val == 203
    assert (orb_priority(sfd0), orb_priority(sfd1)) == (ORB_PRIO_MAX, ORB_PRIO_MIN)
    assert orb_group_count(meta) == 2
    assert orb_exists(meta, 1)
    orb_unadvertise(pfd0)
    assert orb_group_count(meta) == 1
    assert not orb_exists(meta, 0)


def test_a_subscriber_gets_earlier_data_by_an_unconditional_copy() -> None:
    """Pitfall 5 of the guide: check is false until something is published after subscribing."""
    meta = ORB_ID("orb_test")
    handle = orb_advertise(meta, OrbTest(val=1))
    sub = orb_subscribe(meta)
    assert not orb_check(sub)
    assert orb_copy(meta, sub).val == 1
    orb_publish(meta, handle, OrbTest(val=2))
    assert orb_check(sub)
    assert px4_poll([px4_pollfd(sub)], 0) == 1
    assert px4_poll([px4_pollfd(sub)], 0) == 1, "a poll without a copy returns at once, again"
    assert orb_copy(meta, sub).val == 2
    assert px4_poll([px4_pollfd(sub)], 0) == 0


def test_queues_and_publish_auto() -> None:
    """A queue keeps its last samples; publish_auto advertises by itself."""
    meta = ORB_ID("orb_test_queue") if "orb_test_queue" in messages.topics() else ORB_ID("orb_test_medium_queue")
    kind = messages.type_for_topic(meta.topic)
    handle = orb_advertise_queue(meta, None, 4)
    sub = orb_subscribe(meta)
    for number in range(10):
        assert orb_publish_auto(meta, handle, kind(val=number), ORB_PRIO_DEFAULT) is handle
    assert [orb_copy(meta, sub).val for _ in range(5)] == [6, 7, 8, 9, 9]
    auto = orb_publish_auto(meta, None, kind(val=1), ORB_PRIO_DEFAULT)
    assert auto.instance == 1
    assert orb_advertise_multi_queue(meta, None, ORB_PRIO_MIN, 2).queue_length == 2


def test_stat_is_zero_until_published() -> None:
    """The µs of the last publication, 0 for never."""
    sub = orb_subscribe(ORB_ID("orb_test"))
    assert orb_stat(sub) == 0
    before = uorb.hrt_absolute_time()
    orb_advertise(ORB_ID("orb_test"), OrbTest(val=1))
    assert before <= orb_stat(sub) <= uorb.hrt_absolute_time()


def test_errors_are_uorbs() -> None:
    """Where C returns -1 an exception carries uORB's errno."""
    meta, other = ORB_ID("orb_test"), ORB_ID("vehicle_attitude")
    fails(errno.ENOENT, ORB_ID, "no_such_topic")
    fails(errno.EINVAL, orb_advertise, meta, VehicleAttitude())
    sub = orb_subscribe(meta)
    fails(errno.EIO, orb_copy, meta, sub)
    handle = orb_advertise(meta, OrbTest(val=7))
    fails(errno.EINVAL, orb_copy, other, sub)
    fails(errno.EINVAL, orb_publish, other, handle, VehicleAttitude())
    fails(errno.EINVAL, orb_publish, meta, handle, VehicleAttitude())
    assert orb_copy(meta, sub).val == 7, "the wrong meta consumed nothing"
    fails(errno.EIO, orb_subscribe_multi, meta, 10)
    assert orb_exists(meta, 10) is False
    assert orb_exists(meta, -1) is False
    for _ in range(9):
        orb_advertise_multi(meta, None)
    fails(errno.EIO, orb_advertise_multi, meta, None)
    orb_unadvertise(handle)
    orb_unadvertise(handle)
    fails(errno.EBADF, orb_publish, meta, handle, OrbTest())
    orb_unsubscribe(sub)
    for call in (orb_unsubscribe, orb_check, orb_stat, orb_priority, orb_get_interval):
        fails(errno.EBADF, call, sub)
    fails(errno.EBADF, orb_set_interval, sub, 10)
    fails(errno.EBADF, orb_copy, meta, sub)


def test_poll_of_several_handles() -> None:
    """revents anew each time, events 0 never reports, closed handles are passed over, none valid is EINVAL."""
    meta = ORB_ID("orb_test")
    subs = [orb_subscribe(meta) for _ in range(3)]
    handle = orb_advertise(meta, OrbTest(val=1))
    orb_unsubscribe(subs[2])
    fds = [px4_pollfd(subs[0]), px4_pollfd(subs[1], events=0), px4_pollfd(subs[2]), px4_pollfd(None)]
    assert px4_poll(fds, 0) == 1
    assert [entry.revents for entry in fds] == [POLLIN, 0, 0, 0]
    orb_copy(meta, subs[0])
    assert px4_poll(fds, 0) == 0
    assert [entry.revents for entry in fds] == [0, 0, 0, 0]
    orb_publish(meta, handle, OrbTest(val=2))
    assert px4_poll([px4_pollfd(subs[0]), px4_pollfd(subs[0])], -1) == 2
    fails(errno.EINVAL, px4_poll, [], 0)
    fails(errno.EINVAL, px4_poll, fds[2:], 0)


def test_the_default_broker_is_made_anew_after_it_was_closed(tmp_path: Path, monkeypatch: Any) -> None:
    """Closing the default broker does not leave the functions without a bus."""
    monkeypatch.setenv("UORB_RUNTIME_DIR", str(tmp_path))
    default_broker().close()
    with default_broker() as broker:
        assert broker.path.startswith(str(tmp_path))
        assert not orb_exists(ORB_ID("orb_test"), 0)
