"""The main job: a real flight replayed on one host, read on another, every value equal, nothing lost unnoticed."""

from math import isnan
from pathlib import Path
from time import monotonic, sleep
from typing import Any

import pytest
from pyulog import ULog

LOGS = Path(__file__).parents[3] / "shared" / "ulg"

# Each log's fast or queued series. The third log lasts 20 minutes, but these series only its first seconds.
FLIGHTS = {
    "pyulog_sample.ulg": ["sensor_combined", "vehicle_attitude", "actuator_outputs"],
    "mcap_example_test_ulog.ulg": ["vehicle_attitude", "sensor_combined", "estimator_innovations.1"],
    "pyulog_sample_log_small.ulg": ["vehicle_attitude", "sensor_combined", "ekf2_timestamps"],
    "pyulog_sample_appended_multiple.ulg": ["vehicle_attitude", "sensor_combined", "ekf2_timestamps"],
}
LONG = "pyulog_sample_log_small.ulg"


def values(message: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """Flatten a message as pyulog names its columns."""
    found: dict[str, Any] = {}
    for name, value in message.items():
        if isinstance(value, list):
            for index, item in enumerate(value):
                part = {f"{prefix}{name}[{index}]": item}
                found.update(values(item, f"{prefix}{name}[{index}].") if isinstance(item, dict) else part)
        elif isinstance(value, dict):
            found.update(values(value, f"{prefix}{name}."))
        else:
            found[prefix + name] = value
    return found


def equal(a: float, b: float) -> bool:
    return a == b or (isnan(a) and isnan(b))


def compare(rows: list[Any], log: ULog, name: str, lost: int) -> None:
    """Check that what was copied are the log's rows, in order, with at most `lost` missing."""
    topic, _, instance = name.partition(".")
    data = log.get_dataset(topic, int(instance or 0)).data
    stamps = [int(stamp) for stamp in data["timestamp"]]
    at = -1
    for row in rows:
        flat = values(row)
        at = stamps.index(flat["timestamp"], at + 1)
        for column, array in data.items():
            assert equal(flat[column], array[at]), (name, at, column)
    assert len(stamps) - len(rows) == lost, f"{name}: {len(rows)} of {len(stamps)} rows, {lost} counted as lost"


@pytest.mark.parametrize("name", FLIGHTS)
@pytest.mark.timeout(120)
def test_a_flight_arrives_on_the_other_host_value_for_value(name: str, hosts: Any) -> None:
    """At four times its pace: every value equal, what is missing is counted, and is nothing."""
    if not (LOGS / name).exists():
        pytest.skip("the flight logs are not part of a clone")
    autopilot, companion = hosts
    topics = FLIGHTS[name]
    only = ["--topics", *topics] if name == LONG else []
    log = ULog(str(LOGS / name))
    reader = companion.reader(*topics)
    player = autopilot.uorb("play", str(LOGS / name), "--rate", "4", *only)
    _, errors = player.communicate(timeout=100)
    assert player.returncode == 0, errors
    rows, lost = reader.rows()
    for topic in topics:
        compare(rows[topic], log, topic, lost[topic])
        assert lost[topic] == 0


def test_a_small_flight_arrives_complete_at_its_own_pace(hosts: Any, make_log: Any, tmp_path: Path) -> None:
    """The same on a log made here, in real time: every row once, in order."""
    autopilot, companion = hosts
    stamps = make_log(tmp_path / "small.ulg", 2.0, 200)
    reader = companion.reader("sensor_combined")
    player = autopilot.uorb("play", str(tmp_path / "small.ulg"))
    _, errors = player.communicate(timeout=30)
    assert player.returncode == 0, errors
    rows, lost = reader.rows()
    assert [row["timestamp"] for row in rows["sensor_combined"]] == stamps
    assert [row["count"] for row in rows["sensor_combined"]] == list(range(400))
    assert lost == {"sensor_combined": 0}


@pytest.mark.parametrize("victim", [0, 1])
def test_a_killed_link_is_reported_and_the_flow_resumes(victim: int, hosts: Any, make_log: Any, tmp_path: Path) -> None:
    """kill -9 of either link: the other side says so within the lease, and all comes back after a restart."""
    killed, other = hosts[victim], hosts[1 - victim]
    autopilot, companion = hosts
    stamps = make_log(tmp_path / "small.ulg", 8.0, 100)
    reader = companion.reader("sensor_combined")
    player = autopilot.uorb("play", str(tmp_path / "small.ulg"))
    deadline = monotonic() + 10
    while not (companion.folder_has("sensor_combined") and autopilot.folder_has("sensor_combined")):
        assert monotonic() < deadline
        sleep(0.01)
    sleep(2.0)  # into the replay: the fault must hit a running flow
    killed.kill()
    assert other.says(f"peer: {killed.name} is down", 2.0)
    killed.start()
    assert other.says(f"peer: {killed.name} is up", 5.0, times=2)
    _, errors = player.communicate(timeout=30)
    assert player.returncode == 0, errors
    rows, _ = reader.rows()
    got = [row["timestamp"] for row in rows["sensor_combined"]]
    assert got == sorted(set(got)), "a sample came twice or out of order"
    assert set(got) <= set(stamps)
    assert got[-1] == stamps[-1]
    assert len(got) > 500, "the flow was down for more than 3 of 8 s"
