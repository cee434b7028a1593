"""`uorb play`: a log's own definitions and instance numbers on the bus, and what is said of damage."""

import json
import signal
import struct
from pathlib import Path
from typing import Any

import pytest

from uorb_net.logs.sink import queue_length
from uorb_net.msg import VehicleAttitude

LOGS = Path(__file__).parents[3] / "shared" / "ulg"
START = 1_000_000
TOPICS = ("log_thing", "vehicle_attitude")


def message(kind: str, body: bytes) -> bytes:
    """Return a ULog message."""
    return struct.pack("<HB", len(body), ord(kind)) + body


def data(msg_id: int, timestamp_us: int, value: float) -> bytes:
    """Return a row."""
    return message("D", struct.pack("<HQf", msg_id, timestamp_us, value))


def subscription(msg_id: int, topic: str, instance: int) -> bytes:
    """Return what begins a series."""
    return message("A", struct.pack("<BH", instance, msg_id) + topic.encode())


@pytest.fixture
def log(tmp_path: Path) -> Path:
    """Half a second of a topic nobody has installed, on instances 0 and 2, and of `vehicle_attitude`."""
    parts = [b"ULog\x01\x12\x35" + struct.pack("<BQ", 1, START)]
    parts += [message("F", f"{topic}:uint64_t timestamp;float value;".encode()) for topic in TOPICS]
    series = [("log_thing", 0), ("log_thing", 2), ("vehicle_attitude", 0)]
    parts += [subscription(i, *entry) for i, entry in enumerate(series)]
    for step in range(10):
        parts += [data(i, START + 50_000 * step, step / 4) for i in range(len(series))]
    path = tmp_path / "thing.ulg"
    path.write_bytes(b"".join(parts))
    return path


def test_rows_arrive_as_the_log_has_them(shell: Any, log: Path) -> None:
    """Nothing is installed for the topic; timestamps are the log's, instance 1 stays free."""
    broker = shell.broker()
    process = shell.spawn("play", str(log), "--topics", "log_*")
    assert shell.until(lambda: len(broker.topics()) == 2)
    output, errors = process.communicate(timeout=10)
    assert (process.returncode, errors) == (0, "")
    assert output.startswith("played 20 rows of 2 series in 1.")
    assert [status.instance for status in broker.topics()] == [0, 2]
    assert [status.generation for status in broker.topics()] == [10, 10]


def test_readers_get_every_row(shell: Any, log: Path) -> None:
    """As fast as possible, and still complete: the queue is deep and kept a while."""
    broker = shell.broker()
    shell.spawn("play", str(log), "--rate", "0", "--topics", "log_thing")
    assert shell.until(lambda: len(broker.topics()) == 2)
    with broker.subscribe("log_thing", 2) as reader:
        rows: list[Any] = []
        while len(rows) < 10:
            assert reader.wait(10.0)
            rows.append(reader.copy())
    assert [(row.timestamp, row.value) for row in rows] == [(START + 50_000 * n, n / 4) for n in range(10)]


def test_a_definition_in_use_leaves_one_series_out(shell: Any, log: Path) -> None:
    """A line for that series; the others are played; status 1, as not all was."""
    shell.broker().subscribe(VehicleAttitude)
    done = shell.run("play", str(log), "--rate", "0")
    assert done.returncode == 1
    assert done.stdout.startswith("played 20 rows of 2 series")
    assert done.stderr.count("\n") == 1
    assert "vehicle_attitude is not played" in done.stderr


def test_a_truncated_log_is_played_and_told(shell: Any, log: Path) -> None:
    """What is whole is played; then one line, status 1."""
    log.write_bytes(log.read_bytes()[:-5])
    done = shell.run("play", str(log), "--rate", "0", "--json")
    assert done.returncode == 1
    summary = json.loads(done.stdout)
    assert (summary["rows"], summary["series"]) == (29, 3)
    assert 1.0 <= summary["seconds"] < 2.0
    assert summary["problem"] in done.stderr
    assert done.stderr.count("\n") == 1
    assert "the log ends inside a message" in done.stderr


def test_what_cannot_be_played_is_one_line(shell: Any, log: Path, tmp_path: Path) -> None:
    """No ULog, no file, no such topic: 1."""
    other = tmp_path / "no.ulg"
    other.write_text("no log")
    for arguments, said in (
        ((str(other),), "is not a ULog file"),
        ((str(tmp_path / "none.ulg"),), "No such file"),
        ((str(log), "--topics", "nix*", "nought"), "no topic with samples matches nix* nought"),
    ):
        status, output, errors = shell.run_here("play", *arguments)
        assert (status, output) == (1, "")
        assert errors.count("\n") == 1
        assert said in errors


@pytest.mark.parametrize(("number", "status"), [(signal.SIGINT, 130), (signal.SIGTERM, 0)])
def test_signals_end_a_loop_at_once(shell: Any, log: Path, number: signal.Signals, status: int) -> None:
    """With --loop the log begins again until then, more often than it has rows."""
    broker = shell.broker()
    process = shell.spawn("play", str(log), "--loop", "--rate", "20")
    assert shell.until(lambda: any(status.generation > 25 for status in broker.topics()))
    process.send_signal(number)
    assert process.communicate(timeout=2.0) == ("", "")
    assert process.returncode == status
    assert not any(status.advertised for status in broker.topics())


def test_queues_are_deep_and_bounded() -> None:
    """255 small samples; large ones take no more than a mebibyte, but 64 always."""
    assert [queue_length(size) for size in (48, 8192, 1 << 20)] == [255, 128, 64]


@pytest.mark.skipif(not LOGS.is_dir(), reason="no flight logs here")
def test_a_real_log(shell: Any) -> None:
    """75 topics in 95 series of a flight controller, with their instances."""
    broker = shell.broker()
    process = shell.spawn("play", str(LOGS / "mcap_example_test_ulog.ulg"), "--rate", "0", "--json")
    output, errors = process.communicate(timeout=20)
    assert (process.returncode, errors) == (0, "")
    summary = json.loads(output)
    assert (summary["series"], summary["rows"]) == (95, 4272)
    assert sum(status.generation for status in broker.topics()) == 4272
