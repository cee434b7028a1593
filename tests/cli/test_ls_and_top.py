"""`uorb ls` and `uorb top`: what there is, and how fast it moves."""

import json
import os
import pty
from collections.abc import Iterator
from threading import Event, Thread
from typing import Any

import pytest

from uorb_net.cli.screen import picture
from uorb_net.cli.top import age_text, wanted
from uorb_net.msg import SensorAccel, VehicleAttitude

TOP_KEYS = [
    *("name", "instance", "subscribers", "rate_hz", "lost"),
    *("queue_length", "size", "origin", "age", "link_lost"),
]


@pytest.fixture
def publishing(shell: Any) -> Iterator[Any]:
    """`sensor_accel` instance 0 published at about 200 Hz, `vehicle_attitude` only subscribed to."""
    broker = shell.broker()
    publication = broker.advertise(SensorAccel, SensorAccel(), queue_length=3)
    broker.subscribe(VehicleAttitude)
    ended = Event()

    def publish() -> None:
        while not ended.wait(0.005):
            publication.publish(SensorAccel())

    thread = Thread(target=publish)
    thread.start()
    yield broker
    ended.set()
    thread.join()


def test_an_empty_bus_is_1(shell: Any) -> None:
    """Nothing to show: an empty list as JSON, else a line that says so."""
    status, output, errors = shell.run_here("ls")
    assert (status, output) == (1, "")
    assert shell.folder in errors
    for verb in (("ls",), ("top", "--once")):
        assert shell.run_here(*verb, "--json") == (1, "[]\n", "")


def test_ls_lists_every_node_aligned(shell: Any) -> None:
    """Advertised and merely subscribed topics, all instances, columns under their headings."""
    broker = shell.broker()
    broker.advertise_multi(SensorAccel)
    broker.advertise_multi(SensorAccel, SensorAccel())
    broker.subscribe(VehicleAttitude)
    done = shell.run("ls")
    assert done.returncode == 0
    head, *rows = done.stdout.splitlines()
    assert [row.split()[:2] for row in rows] == [
        ["sensor_accel", "0"],
        ["sensor_accel", "1"],
        ["vehicle_attitude", "0"],
    ]
    assert [row[head.index("TYPE") :].split()[0] for row in rows] == ["SensorAccel"] * 2 + ["VehicleAttitude"]
    assert [row[head.index("ADV") :].split()[0] for row in rows] == ["yes", "yes", "no"]


def test_ls_json_is_topic_status(shell: Any) -> None:
    """Every field of `TopicStatus`, as the library reports it."""
    broker = shell.broker()
    broker.advertise(SensorAccel, SensorAccel())
    found = json.loads(shell.run("ls", "--json").stdout)
    status = broker.topics()[0]
    assert found == [{name: getattr(status, name) for name in status.__struct_fields__}]


def test_vehicles_have_their_own_bus(shell: Any) -> None:
    """`--vehicle` and the environment choose; they do not mix."""
    shell.broker().advertise(SensorAccel, SensorAccel())
    assert shell.run("ls", "--vehicle", "uav2").returncode == 1
    assert shell.run("ls", UORB_VEHICLE="uav2").returncode == 1
    assert shell.run("ls", "--vehicle", "default", UORB_VEHICLE="uav2").returncode == 0


@pytest.mark.usefixtures("publishing")
def test_top_json_has_every_node(shell: Any) -> None:
    """Rates from two looks, totals of losses, null for never."""
    done = shell.run("top", "--once", "--json")
    assert done.returncode == 0
    accel, attitude = json.loads(done.stdout)
    assert list(accel) == TOP_KEYS
    assert (accel["name"], accel["instance"], accel["queue_length"]) == ("sensor_accel", 0, 3)
    assert 50 < accel["rate_hz"] <= 210
    assert accel["size"] == SensorAccel.__uorb__.payload_length
    assert 0 <= accel["age"] < 1
    assert (attitude["subscribers"], attitude["rate_hz"], attitude["age"]) == (1, 0.0, None)


@pytest.mark.usefixtures("publishing")
def test_top_shows_what_is_published(shell: Any) -> None:
    """The text leaves out silent topics, unless asked for by -a or by name."""
    runs = [shell.spawn("top", "--once", *more) for more in ((), ("-a",), ("attitude",))]
    output, everything, filtered = [run.communicate(timeout=10)[0].splitlines() for run in runs]
    header, columns, *rows = output
    assert header == "update: 1s, num topics: 2"
    assert columns.split()[:6] == ["TOPIC", "NAME", "INST", "#SUB", "#MSG", "#LOST"]
    assert columns.split()[6:] == ["#QSIZE", "SIZE", "ORIGIN", "AGE", "NETLOST"]
    assert [row.split()[0] for row in rows] == ["sensor_accel"]
    assert len(everything) == 4
    assert [row.split()[0] for row in filtered[2:]] == ["vehicle_attitude"]


def test_top_counts_losses_in_total(shell: Any, publishing: Any) -> None:
    """A reader that falls behind shows up, with all it ever lost."""
    slow = publishing.subscribe(SensorAccel)
    process = shell.spawn("top", "--json")
    rows = []
    for _ in range(3):
        rows.append(json.loads(process.stdout.readline())[0])
        assert slow.wait(10.0)
        slow.copy()
    assert rows[0]["subscribers"] == 1
    assert 0 < rows[2]["lost"] <= slow.lost


@pytest.mark.usefixtures("publishing")
def test_top_repeats_into_a_pipe_as_plain_text(shell: Any) -> None:
    """No control codes where no terminal is."""
    process = shell.spawn("top")
    lines = [process.stdout.readline() for _ in range(7)]
    assert lines[0] == lines[4] == "update: 1s, num topics: 2\n"
    assert lines[3] == "\n"
    assert "\x1b" not in "".join(lines)


@pytest.mark.usefixtures("publishing")
def test_top_redraws_a_terminal_until_q(shell: Any) -> None:
    """The cursor goes home instead of the picture being cleared; q ends with 0."""
    terminal, end = pty.openpty()
    process = shell.spawn("top", stdin=end, stdout=end)
    os.close(end)
    seen = b""
    while seen.count(b"num topics: 2") < 2:
        seen += os.read(terminal, 4096)
    os.write(terminal, b"q")
    assert process.wait(2.0) == 0
    os.close(terminal)
    assert seen.count(b"\x1b[2J") == 1
    assert seen.count(b"\x1b[H") == 2


def test_a_picture_fits_its_terminal() -> None:
    """Lines are cut at the width; what has no room is counted."""
    drawn = picture([f"line {i}" for i in range(10)], os.terminal_size((6, 5)), first=False)
    assert drawn.count("\n") == 4
    assert "line 2" in drawn
    assert "line 3" not in drawn
    wide = picture([f"line {i}" for i in range(10)], os.terminal_size((80, 5)), first=False)
    assert "... 7 more" in wide


def test_filters_and_ages() -> None:
    """A filter is part of a name or a pattern; an age has a unit that suits it."""
    assert wanted("sensor_accel", ["accel"])
    assert wanted("sensor_accel", ["nothing", "sensor_*"])
    assert not wanted("sensor_accel", ["*_gyro"])
    assert [age_text(a) for a in (None, 0.004, 59.6, 1200.0)] == ["-", "0.00s", "60s", "20m"]
