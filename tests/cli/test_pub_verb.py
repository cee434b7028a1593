"""`uorb pub`: what is published, how long it stays, and what is refused before anything is sent."""

import json
import math
import time
from typing import Any

import pytest

from uorb_net.msg import PositionSetpointTriplet, SensorAccel


def test_one_sample_is_held_for_readers(shell: Any) -> None:
    """Fields by name, the rest 0, `timestamp` stamped; the advertisement ends after --hold."""
    broker = shell.broker()
    subscription = broker.subscribe(SensorAccel)
    before = time.monotonic_ns() // 1000
    process = shell.spawn(
        *("pub", "sensor_accel", '{"x": 0.5, "y": null, "z": "-inf", "clip_counter": [1, 2, 3]}'),
        *("--hold", "0.3"),
    )
    assert subscription.wait(10.0)
    message = subscription.copy()
    assert (message.x, message.z, message.clip_counter) == (0.5, -math.inf, bytes([1, 2, 3]))
    assert math.isnan(message.y)
    assert before < message.timestamp < time.monotonic_ns() // 1000
    assert process.wait(10) == 0
    assert not broker.exists(SensorAccel)


def test_what_listener_prints_can_be_published(shell: Any) -> None:
    """The JSON of the one is that of the other."""
    broker = shell.broker()
    nested = PositionSetpointTriplet.__uorb__.nested["PositionSetpoint"]
    message = PositionSetpointTriplet(timestamp=3, current=nested(lat=47.123456789, alt=math.nan))
    broker.advertise(PositionSetpointTriplet, message)
    line = json.loads(shell.run("listener", "position_setpoint_triplet", "--json").stdout)
    again = broker.subscribe(PositionSetpointTriplet, start="new")
    done = shell.run("pub", "position_setpoint_triplet", json.dumps(line["message"]), "--hold", "0")
    assert done.returncode == 0
    assert PositionSetpointTriplet.__uorb__.encode(again.copy(), 0) == message.__uorb__.encode(message, 0)


@pytest.mark.parametrize("number", [0, 3])
def test_the_instance_is_the_one_asked_for(shell: Any, number: int) -> None:
    """Also where lower ones are free."""
    broker = shell.broker()
    process = shell.spawn("pub", "sensor_accel", "{}", "-i", str(number), "--hold", "20")
    assert shell.until(lambda: broker.exists(SensorAccel, number))
    assert broker.group_count(SensorAccel) == 1
    process.terminate()
    assert process.wait(5) == 0
    assert not broker.exists(SensorAccel, number)


def test_a_rate_and_a_count(shell: Any) -> None:
    """`-r 50 -n 10` takes about 0.2 s and stamps each sample anew."""
    broker = shell.broker()
    subscription = broker.subscribe(SensorAccel, start="new")
    process = shell.spawn("pub", "sensor_accel", "{}", "-r", "50", "-n", "10", "--hold", "0.2")
    stamps: list[int] = []
    while len(stamps) < 10:
        assert subscription.wait(10.0)
        stamps.append(subscription.copy().timestamp)
    assert process.wait(10) == 0
    assert 150_000 < stamps[-1] - stamps[0] < 1_000_000
    assert len(set(stamps)) == 10


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("{x: 1}", "bad JSON"),
        ("", "bad JSON"),
        ("[1]", "object"),
        ('{"x": 1, "x": 2}', "twice"),
        ('{"clip_conter": [1, 2, 3]}', "did you mean clip_counter?"),
        ('{"qqqqqq": 1}', "fields are timestamp"),
        ('{"x": "fast"}', "SensorAccel.x = 'fast'"),
        ('{"x": 1e999}', "beyond float64"),
        ('{"x": 1e39}', "3.4028235e+38"),
        ('{"x": true}', "a number"),
        ('{"x": [1]}', "a number"),
        ('{"clip_counter": [1, 2]}', "a sequence of 3"),
        ('{"clip_counter": [1, 2, 256]}', "clip_counter[2] = 256"),
        ('{"clip_counter": [1, 2, null]}', "0..255"),
        ('{"device_id": -1}', "0..4294967295"),
        ('{"device_id": 1.5}', "an integer"),
        ('{"device_id": true}', "an integer"),
        ("[" * 100_000, "bad JSON"),
    ],
)
def test_what_does_not_fit_is_2_and_nothing_is_published(shell: Any, text: str, said: str) -> None:
    """One line names the fault; nobody was advertised, not even for a moment."""
    status, output, errors = shell.run_here("pub", "sensor_accel", text)
    assert (status, output) == (2, "")
    assert errors.count("\n") == 1
    assert said in errors
    assert shell.broker().topics() == []


@pytest.mark.parametrize(
    ("topic", "text", "said"),
    [
        ("position_setpoint_triplet", '{"current": {"lat": "north"}}', "current.lat = 'north'"),
        ("position_setpoint_triplet", '{"current": {"latt": 1}}', "current.latt: did you mean lat"),
        ("position_setpoint_triplet", '{"current": 1}', "an object of PositionSetpoint's fields"),
        ("sensor_acel", "{}", "did you mean sensor_accel"),
    ],
)
def test_faults_deep_inside_are_named(shell: Any, topic: str, text: str, said: str) -> None:
    """The path to the field is in the line."""
    status, _, errors = shell.run_here("pub", topic, text)
    assert status == 2
    assert said in errors
