"""Channels in processes that die, freeze, fork and exit as processes do."""

import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, closing

import pytest

from communicator import Advert, Peer, SampleHeader, ZenohChannel
from communicator.recorder import Event, Recorder

ADVERT = Advert("imu", 0, "px4_msgs/msg/Imu", "RIHS01_" + "0" * 64, 52, 1, 50, True)
COMMON = """
import os, sys, threading
from communicator import Advert, ChannelError, SampleHeader, ZenohChannel
from communicator.recorder import Recorder
ADVERT = Advert("imu", 0, "px4_msgs/msg/Imu", "RIHS01_" + "0" * 64, 52, 1, 50, True)
class Echo(Recorder):
    def process_remote_topic(self, peer, advert, advertised):
        channel.add_subscription(peer, advert.topic, advert.instance, 0)
    def process_received_message(self, peer, topic, instance, header, payload):
        channel.send_message(peer, topic, instance, header, payload)
        channel.flush()
channel = ZenohChannel(connect=[sys.argv[1]], lease=0.6)
handler = Echo()
channel.register_handler(handler)
channel.start("uav1", "companion")
channel.topic_advertised(ADVERT)
"""
PEER = COMMON + "print(channel.own.instance_id, flush=True)\nsys.stdin.read()\n"
FORK = (
    COMMON
    + """
child = os.fork()
if child == 0:
    for verb in (channel.flush, channel.counters, lambda: channel.start("uav1", "x")):
        try:
            verb()
        except ChannelError as error:
            assert "before fork" in str(error)
        else:
            os._exit(3)
    channel.stop()
    sys.exit(7)
print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), flush=True)
channel.stop()
"""
)


@pytest.fixture
def stack() -> Iterator[ExitStack]:
    with ExitStack() as made:
        yield made


@pytest.fixture
def endpoint() -> str:
    with closing(socket.socket()) as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


def run(stack: ExitStack, code: str, endpoint: str) -> subprocess.Popen[str]:
    """Start a process of `code` that is killed at the test's end."""
    process = subprocess.Popen(
        [sys.executable, "-W", "ignore", "-c", code, endpoint],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        cwd=os.path.dirname(os.path.dirname(os.path.dirname(os.path.abspath(__file__)))),
    )
    stack.enter_context(process)
    stack.callback(process.kill)
    return process


def companion(stack: ExitStack, endpoint: str) -> tuple[subprocess.Popen[str], Peer]:
    """Start a peer process and return it with its name."""
    process = run(stack, PEER, endpoint)
    assert process.stdout is not None
    return process, Peer("companion", process.stdout.readline().strip())


def here(stack: ExitStack, endpoint: str) -> tuple[ZenohChannel, Recorder]:
    """Start this process's channel."""
    channel, handler = ZenohChannel(listen=[endpoint], lease=0.6), Recorder()
    channel.register_handler(handler)
    channel.start("uav1", "autopilot")
    channel.topic_advertised(ADVERT)
    stack.callback(channel.stop)
    return channel, handler


def echoes(channel: ZenohChannel, handler: Recorder, peer: Peer, number: int) -> bool:
    """Wait until the peer wants samples, send one and wait for its echo."""
    assert handler.wait_for("add_subscription", peer, "imu", 0, 0)
    channel.send_message(peer, "imu", 0, SampleHeader(number, 0), b"abc")
    channel.flush()

    def back(events: list[Event]) -> bool:
        samples = [e for e in events if e[:4] == ("received_message", peer, "imu", 0)]
        return any(isinstance(e[4], SampleHeader) and e[4].sequence == number for e in samples)

    return handler.wait(back)


def test_a_killed_process_goes_at_once_and_its_successor_is_another_peer(stack: ExitStack, endpoint: str) -> None:
    channel, handler = here(stack, endpoint)
    first_process, first = companion(stack, endpoint)
    assert handler.wait_for("remote_topic", first, ADVERT, True)
    assert echoes(channel, handler, first, 1)
    first_process.send_signal(signal.SIGKILL)
    assert handler.wait_for("peer", first, False, timeout=1.0)
    _, second = companion(stack, endpoint)
    assert second.instance_id != first.instance_id
    assert handler.wait_for("remote_topic", second, ADVERT, True)
    assert echoes(channel, handler, second, 2)


def test_a_frozen_process_is_lost_after_the_lease_and_returns_when_it_thaws(stack: ExitStack, endpoint: str) -> None:
    channel, handler = here(stack, endpoint)
    process, peer = companion(stack, endpoint)
    assert handler.wait_for("remote_topic", peer, ADVERT, True)
    process.send_signal(signal.SIGSTOP)
    assert handler.wait_for("peer", peer, False)
    handler.clear()
    process.send_signal(signal.SIGCONT)
    assert handler.wait_for("remote_topic", peer, ADVERT, True)
    assert handler.events[0] == ("peer", peer, True)
    assert echoes(channel, handler, peer, 1)


def test_flushing_to_a_frozen_process_blocks_nobody_and_stop_is_quick(stack: ExitStack, endpoint: str) -> None:
    channel, handler = here(stack, endpoint)
    process, peer = companion(stack, endpoint)
    assert handler.wait_for("remote_topic", peer, ADVERT, True)
    watcher, watched = ZenohChannel(connect=[endpoint], lease=0.6), Recorder()
    watcher.register_handler(watched)
    watcher.start("uav1", "watcher")
    stack.callback(watcher.stop)
    assert watched.wait_for("peer", channel.own, True)
    process.send_signal(signal.SIGSTOP)
    slowest = 0.0
    for number in range(1, 200):  # 20 MB: far more than sockets hold
        channel.send_message(peer, "imu", 0, SampleHeader(number, 0), bytes(100_000))
        began = time.monotonic()
        channel.flush()
        slowest = max(slowest, time.monotonic() - began)
    assert slowest < 0.3
    began = time.monotonic()
    channel.stop()
    assert time.monotonic() - began < 2.0
    assert watched.wait_for("peer", channel.own, False, timeout=1.0)  # though Zenoh may close for 10 s


def test_a_forked_child_is_told_and_exits(stack: ExitStack, endpoint: str) -> None:
    here(stack, endpoint)
    process = run(stack, FORK, endpoint)
    out, _ = process.communicate(timeout=20)
    assert out.strip() == "7"
    assert process.returncode == 0


@pytest.mark.parametrize("ending", ["", "raise SystemExit(0)", "del channel"])
def test_a_process_ends_with_its_channel_open(stack: ExitStack, endpoint: str, ending: str) -> None:
    _, handler = here(stack, endpoint)
    process = run(stack, COMMON + "handler.wait(lambda events: events)\n" + ending, endpoint)
    process.communicate(timeout=20)
    assert process.returncode == 0
    assert handler.wait(lambda events: any(e[0] == "peer" and e[2] is False for e in events))
