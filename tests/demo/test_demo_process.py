"""The demo as a real command: what it shows, and that it leaves nothing, however it ends."""

import re
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

Start = Callable[..., Any]
LOG = Path(__file__).parents[3] / "shared" / "ulg" / "mcap_example_test_ulog.ulg"
ROW = re.compile(r"^(\w+) +(\d) +([\d.]+) +(\d+) +(\d+) +(.+?)  (\w+)$", re.MULTILINE)


def rows(text: str) -> dict[tuple[str, int, str], float]:
    """Return rates by topic, instance and origin; nothing may be lost."""
    found = {}
    for topic, instance, rate, lost, net_lost, _, origin in ROW.findall(text):
        assert (lost, net_lost) == ("0", "0"), topic
        found[topic, int(instance), origin] = float(rate)
    return found


def test_a_flight_of_three_seconds(demo: Start) -> None:
    """Both hosts' topics come through at their rates, none is lost, the account balances, status 0."""
    running = demo("--seconds", "3")
    folder = running.folder
    status, output, errors = running.end()
    assert (status, errors) == (0, "")
    assert max(map(len, output.splitlines())) <= 100
    assert "\x1b" not in output
    last = rows(output[output.rindex("uorb demo:") :])
    assert len([key for key in last if key[2] == "autopilot"]) == 16
    assert last["sensor_combined", 0, "autopilot"] == pytest.approx(200, rel=0.2)
    assert last["sensor_accel", 1, "autopilot"] == pytest.approx(100, rel=0.2)
    assert last["battery_status", 0, "autopilot"] > 0
    assert last["estimator_attitude", 0, "companion"] == pytest.approx(20, rel=0.3)
    assert output.count("uorb demo:") in (3, 4)
    assert "vehicle_attitude  " in output
    assert re.search(r"^autopilot +\d+  companion +\d+ +\d+ +0 +0 ", output, re.MULTILINE)
    assert "published = samples + early + lost + netlost, on both hosts" in output
    assert not folder.exists()


def test_ctrl_c(demo: Start, all_gone: Callable[[list[int]], bool]) -> None:
    """The summary is shown, status 130, nothing is left."""
    running = demo()
    folder, hosts = running.folder, running.hosts()
    running.process.send_signal(signal.SIGINT)
    status, output, errors = running.end(5.0)
    assert (status, errors) == (130, "")
    assert "summary: simulated flight" in output
    assert all_gone(hosts)
    assert not folder.exists()


def test_sigterm(demo: Start, all_gone: Callable[[list[int]], bool]) -> None:
    """Status 0 within 2 s and nothing is left."""
    running = demo()
    folder, hosts = running.folder, running.hosts()
    running.process.terminate()
    assert running.end(2.0)[0] == 0
    assert all_gone(hosts)
    assert not folder.exists()


def test_a_killed_demo_leaves_nothing(demo: Start, all_gone: Callable[[list[int]], bool]) -> None:
    """The hosts notice that their parent is gone, and remove the folder."""
    running = demo()
    folder, hosts = running.folder, running.hosts()
    running.process.kill()
    assert all_gone(hosts)
    assert not folder.exists()


def test_a_killed_host_ends_the_demo(demo: Start, kill_one: Callable[[list[int]], None]) -> None:
    """One line says which, status 1."""
    running = demo()
    folder = running.folder
    kill_one(running.hosts())
    status, _, errors = running.end(5.0)
    assert status == 1
    assert re.fullmatch(r"uorb demo: (autopilot|companion) was killed: SIGKILL\n", errors)
    assert not folder.exists()


def test_a_closed_pipe_ends_it_quietly(demo: Start) -> None:
    """As in `uorb demo | head -1`."""
    running = demo()
    folder = running.folder
    running.close_output()
    status, _, errors = running.end(5.0)
    assert (status, errors) == (0, "")
    assert not folder.exists()


@pytest.mark.skipif(not LOG.exists(), reason=f"needs the flight log {LOG.name}, which is not there")
def test_a_played_flight(demo: Start) -> None:
    """All topics and instances of a log arrive with the log's own definitions, and the attitude is estimated."""
    status, output, errors = demo("--log", str(LOG), "--seconds", "3").end()
    assert (status, errors) == (0, "")
    last = rows(output[output.rindex("uorb demo:") :])
    assert len(last) == 95
    assert last["sensor_combined", 0, "autopilot"] > 100
    assert ("estimator_states", 1, "autopilot") in last
    assert "companion's estimate" in output
    assert "published = samples + early + lost + netlost, on both hosts" in output


@pytest.mark.parametrize(
    ("content", "complaint"),
    [(None, "No such file or directory"), (b"no log at all, just text", "is not a ULog file")],
)
def test_a_file_that_is_no_log(demo: Start, tmp_path: Path, content: bytes | None, complaint: str) -> None:
    """One line, status 1."""
    path = tmp_path / "bad.ulg"
    if content is not None:
        path.write_bytes(content)
    status, output, errors = demo("--log", str(path)).end()
    assert (status, output) == (1, "")
    assert errors.startswith("uorb demo: ")
    assert errors.endswith(f"{complaint}\n")
    assert errors.count("\n") == 1


def test_a_log_without_samples(demo: Start, tmp_path: Path) -> None:
    """It is found out by the process that plays it: one line, status 1."""
    path = tmp_path / "empty.ulg"
    path.write_bytes(b"ULog\x01\x12\x35\x01" + bytes(8))
    status, output, errors = demo("--log", str(path)).end()
    assert (status, output) == (1, "")
    assert errors == f"uorb demo: autopilot: {path} has no samples\n"
