"""`uorb listener`: the sample already there, those that follow, and what is said where none comes."""

import json
import math
from time import monotonic
from typing import Any

import pytest

from uorb_net.msg import SensorAccel, VehicleAttitude


def accel(number: int, **fields: Any) -> Any:
    """Return a numbered sample."""
    return SensorAccel(timestamp=1000 + number, **fields)


def test_the_sample_already_there_comes_first(shell: Any) -> None:
    """One sample unless more are asked for, each field on a line, in the order of the definition."""
    values = accel(1, x=0.1, y=-1.0, z=math.nan, temperature=math.inf, clip_counter=(1, 2, 3), device_id=7)
    shell.broker().advertise(SensorAccel, values)
    done = shell.run("listener", "sensor_accel")
    assert done.returncode == 0
    assert done.stdout == (
        "TOPIC: sensor_accel #1\ntimestamp: 1001\ntimestamp_sample: 0\ndevice_id: 7\nx: 0.1\ny: -1\nz: nan\n"
        "temperature: inf\nerror_count: 0\nclip_counter: [1, 2, 3]\nsamples: 0\n"
    )


@pytest.mark.parametrize("how", [["3"], ["-n", "3"]])
def test_blocks_are_numbered_and_apart(shell: Any, how: list[str]) -> None:
    """Samples that follow come in turn; an empty line lies between two blocks."""
    broker = shell.broker()
    publication = broker.advertise(SensorAccel, accel(0), queue_length=8)
    process = shell.spawn("listener", "sensor_accel", *how)
    assert shell.until(lambda: broker.topics()[0].subscribers == 1)
    publication.publish(accel(1))
    publication.publish(accel(2))
    output, _ = process.communicate(timeout=10)
    assert process.returncode == 0
    blocks = output.split("\n\n")
    assert [block.splitlines()[:2] for block in blocks] == [
        [f"TOPIC: sensor_accel #{n + 1}", f"timestamp: {1000 + n}"] for n in range(3)
    ]


def test_other_instances_are_named(shell: Any) -> None:
    """`TOPIC: name instance I #N`."""
    broker = shell.broker()
    broker.advertise_multi(SensorAccel, accel(0))
    broker.advertise_multi(SensorAccel, accel(5))
    output = shell.run("listener", "sensor_accel", "-i", "1").stdout
    assert output.splitlines()[:2] == ["TOPIC: sensor_accel instance 1 #1", "timestamp: 1005"]


def test_json_is_a_line_a_sample(shell: Any) -> None:
    """NaN is null, infinities are words, bytes a list; the message equals the library's."""
    broker = shell.broker()
    broker.advertise(SensorAccel, accel(1, x=0.1, y=math.nan, z=-math.inf, clip_counter=(9, 0, 255)))
    done = shell.run("listener", "sensor_accel", "--json")
    assert done.stdout.count("\n") == 1
    found = json.loads(done.stdout)
    sample = broker.subscribe(SensorAccel).copy_with_info()
    message = found.pop("message")
    assert found == {
        "topic": "sensor_accel",
        "instance": 0,
        "origin": broker.host,
        "generation": 1,
        "published_us": sample.info.published_us,
    }
    assert list(message) == list(SensorAccel.__struct_fields__)
    assert (message["x"], message["y"], message["z"]) == (sample.message.x, None, "-inf")
    assert message["clip_counter"] == [9, 0, 255]


def test_a_rate_spaces_the_samples(shell: Any) -> None:
    """`-r 10` shows every tenth of a second what is newest; waiting for it counts as no silence."""
    publication = shell.broker().advertise(SensorAccel, accel(0), queue_length=8)
    process = shell.spawn("listener", "sensor_accel", "-n", "5", "-r", "10", "--json", "--timeout", "0.05")
    assert shell.until(lambda: publication.publish(accel(0)) or process.poll() is not None)
    times = [json.loads(line)["published_us"] for line in process.stdout.read().splitlines()]
    assert len(times) == 5
    assert times[-1] - times[0] > 250_000  # after a pause two may come close together


def test_never_published(shell: Any) -> None:
    """A topic that is defined, and that nobody advertises: 1."""
    done = shell.run("listener", "sensor_accel", "--timeout", "0.1")
    assert (done.returncode, done.stdout, done.stderr) == (1, "", "never published\n")


def test_silence(shell: Any) -> None:
    """Advertised, but nothing comes: 1, and how long it waited; also after a first sample."""
    publication = shell.broker().advertise(SensorAccel)
    silent = shell.run("listener", "sensor_accel", "--timeout", "0.2")
    assert silent.returncode == 1
    assert silent.stderr == "Waited for 0.2 seconds without a message. Giving up.\n"
    publication.publish(accel(0))
    one = shell.run("listener", "sensor_accel", "2", "--timeout", "0.2")
    assert one.returncode == 1
    assert one.stdout.startswith("TOPIC: sensor_accel #1\n")
    assert one.stderr == "Waited for 0.2 seconds without a message. Giving up.\n"


def test_the_default_timeout_is_two_seconds(shell: Any) -> None:
    """It is told as uORB tells it."""
    shell.broker().advertise(SensorAccel)
    began = monotonic()
    done = shell.run("listener", "sensor_accel")
    assert 1.9 < monotonic() - began < 4.0
    assert done.stderr == "Waited for 2.0 seconds without a message. Giving up.\n"


@pytest.mark.parametrize("name", ["sensor_acel", "../secret", "a b"])
def test_an_unknown_topic_is_2(shell: Any, name: str) -> None:
    """Neither defined here nor on the bus when the timeout ends; near names are offered."""
    done = shell.run("listener", name, "--timeout", "0.1")
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.count("\n") == 1
    assert ("did you mean sensor_accel" in done.stderr) == (name == "sensor_acel")


def test_a_definition_only_the_bus_knows(shell: Any, strange_definitions: str) -> None:
    """The publisher's text is enough; waiting begins before it is there."""
    process = shell.spawn("listener", "strange_thing", "--timeout", "20")
    values = {
        "timestamp": 5,
        "pair": [0.3, None],
        "label": 'a "b"',
        "part": {"wide": 0.1, "raw": [1, 2, 3]},
        "parts": [{"wide": "inf"}, {}],
        "on": True,
    }
    shell.spawn("pub", "strange_thing", json.dumps(values), "--hold", "20", UORB_MSG_PATH=strange_definitions)
    output, _ = process.communicate(timeout=20)
    assert output == (
        'TOPIC: strange_thing #1\ntimestamp: 5\npair: [0.3, nan]\nlabel: "a \\"b\\""\npart:\n  timestamp: 0\n'
        "  wide: 0.1\n  raw: [1, 2, 3]\nparts[0]:\n  timestamp: 0\n  wide: inf\n  raw: [0, 0, 0]\n"
        "parts[1]:\n  timestamp: 0\n  wide: 0\n  raw: [0, 0, 0]\non: True\n"
    )
    document = json.loads(shell.run("listener", "strange_thing", "--json").stdout)["message"]
    assert document["parts"][0] == {"timestamp": 0, "wide": "inf", "raw": [0, 0, 0]}
    assert (document["label"], document["on"]) == ('a "b"', True)


def test_the_publishers_definition_counts(shell: Any, strange_definitions: str) -> None:
    """A topic published with another definition than the one installed here is shown as published."""
    broker = shell.broker()
    shell.spawn(
        *("pub", "vehicle_attitude", '{"q": [1, 0, 0, 0.5], "extra": -3}', "--hold", "20"),
        UORB_MSG_PATH=strange_definitions,
    )
    assert shell.until(lambda: any(node.generation for node in broker.topics()))
    assert "extra" not in VehicleAttitude.__struct_fields__
    lines = shell.run("listener", "vehicle_attitude").stdout.splitlines()
    assert lines[2:] == ["q: [1, 0, 0, 0.5]", "extra: -3"]
