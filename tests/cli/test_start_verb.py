"""`uorb start`, and verbs that carry their own link: configuration, readiness, two hosts over TCP."""

import json
import os
import signal
import socket
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from uorb_net.cli import UsageError
from uorb_net.cli.options import Parser, add_common
from uorb_net.cli.settings import DEFAULT_LISTEN, Settings, settings
from uorb_net.msg import SensorAccel, VehicleAttitude


def chosen(*arguments: str) -> Settings:
    """Return the settings of a command line."""
    parser = Parser("uorb start")
    add_common(parser)
    return settings(parser.parse_args(arguments))


def ready(process: Any) -> str:
    """Return the line a link says when it runs."""
    line = process.stderr.readline()
    assert " listens on " in line or " connects to " in line
    return str(line)


def test_without_endpoints_it_listens_on_loopback() -> None:
    """As the contract says; a client has no place to listen on."""
    assert chosen().listen == [DEFAULT_LISTEN]
    assert chosen("--connect", "tcp/a:1").listen == []
    assert chosen("--mode", "client").listen == []


def test_flags_overrule_the_file(tmp_path: Path) -> None:
    """Endpoints as a whole; TLS files lie beside the file that names them."""
    path = tmp_path / "uorb.toml"
    path.write_text(
        'host = "a"\nvehicle = "v"\nlisten = ["tls/0.0.0.0:1"]\nmode = "router"\nlease = 3\n'
        '[tls]\nca = "ca.pem"\ncertificate = "/etc/a.pem"\nkey = "a.key"\n'
        '[classes.fast]\ntopics = ["sensor_*"]\npriority = 2\nmax_rate = 50\nresend = true\n'
    )
    found = chosen("--config", str(path), "--host", "b")
    assert (found.host, found.vehicle, found.mode, found.lease) == ("b", "v", "router", 3.0)
    assert found.tls is not None
    assert found.tls.ca == str(tmp_path / "ca.pem")
    assert found.tls.certificate == "/etc/a.pem"
    assert found.classes["fast"].topics == ["sensor_*"]
    other = chosen("--config", str(path), "--connect", "tcp/c:1")
    assert (other.listen, other.connect) == ([], ["tcp/c:1"])


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("liste = []", "liste"),
        ("[tls]\nca = ''\ncertificate = ''\nkey = ''\npassword = ''", "password"),
        ("[classes.fast]\npriorty = 1", "priorty"),
        ("[classes.fast]\npriority = 8", "priority"),
        ("listen = 'tcp/a:1'", "listen"),
        ("lease = 'long'", "lease"),
        ("observer = true", "observer"),
        ("not toml", "not TOML"),
    ],
)
def test_a_wrong_key_is_named(tmp_path: Path, text: str, named: str) -> None:
    """With the file."""
    path = tmp_path / "uorb.toml"
    path.write_text(text)
    with pytest.raises(UsageError, match=named) as caught:
        chosen("--config", str(path))
    assert str(path) in str(caught.value)


def test_a_wrong_configuration_is_2_and_a_missing_one_1(shell: Any, tmp_path: Path) -> None:
    """One line each."""
    path = tmp_path / "uorb.toml"
    path.write_text("liste = []")
    wrong = shell.run("start", "--config", str(path))
    assert (wrong.returncode, wrong.stderr.count("\n")) == (2, 1)
    assert "liste" in wrong.stderr
    missing = shell.run("start", "--config", str(tmp_path / "none.toml"))
    assert (missing.returncode, missing.stderr.count("\n")) == (1, 1)


def test_a_second_link_is_1_and_names_the_process(shell: Any, far: Any, endpoint: str) -> None:
    """On the same bus whatever its endpoint; on another bus a port in use is named."""
    first = shell.spawn("start", "--listen", endpoint)
    ready(first)
    second = shell.run("start", "--listen", endpoint[:-1])
    assert second.returncode == 1
    assert f"process {first.pid}" in second.stderr
    elsewhere = far.run("start", "--listen", endpoint)
    assert elsewhere.returncode == 1
    assert endpoint in elsewhere.stderr
    assert elsewhere.stderr.count("\n") == 1
    carried = shell.run("ls", "--connect", endpoint)
    assert carried.returncode == 1
    assert f"process {first.pid}" in carried.stderr


def test_a_service_manager_is_told(shell: Any, endpoint: str, tmp_path: Path) -> None:
    """READY=1, the watchdog as often as it wants, STOPPING=1."""
    address = str(tmp_path / "notify")
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.bind(address)
        manager.settimeout(10)
        process = shell.spawn(
            "start", "--listen", endpoint, NOTIFY_SOCKET=address, WATCHDOG_USEC="200000", WATCHDOG_PID=""
        )
        assert manager.recv(100) == b"READY=1"
        process.send_signal(signal.SIGTERM)
        assert process.wait(2.0) == 0
        assert manager.recv(100) == b"STOPPING=1"

        environment = {"NOTIFY_SOCKET": address, "WATCHDOG_USEC": "200000"}
        process = shell.spawn("start", "--listen", endpoint, **environment)
        said = [manager.recv(100) for _ in range(4)]
        assert said == [b"READY=1"] + [b"WATCHDOG=1"] * 3
        os.kill(process.pid, signal.SIGINT)
        assert process.wait(2.0) == 130


@pytest.fixture
def hosts(shell: Any, far: Any, endpoint: str) -> Iterator[tuple[Any, Any]]:
    """Two hosts, each with a running `uorb start`."""
    first = shell.spawn("start", "--host", "autopilot", "--listen", endpoint)
    second = far.spawn("start", "--host", "companion", "--connect", endpoint)
    ready(first), ready(second)
    yield shell, far
    for process in (first, second):
        process.terminate()
        assert process.wait(2.0) == 0


def test_a_listener_hears_the_other_host(hosts: tuple[Any, Any]) -> None:
    """From either side, with the origin's name."""
    for here, there, name in ((*hosts, "autopilot"), (*hosts[::-1], "companion")):
        publisher = here.spawn("pub", "sensor_accel", '{"x": 0.25, "timestamp": 9}', "--hold", "20")
        done = there.run("listener", "sensor_accel", "--json", "--timeout", "10")
        assert done.returncode == 0, done.stderr
        sample = json.loads(done.stdout)
        assert (sample["origin"], sample["message"]["x"], sample["message"]["timestamp"]) == (name, 0.25, 9)
        publisher.terminate()
        publisher.wait()
        assert there.until(lambda there=there: '"advertised":true' not in there.run("ls", "--json").stdout)


def test_a_definition_only_the_other_host_has(hosts: tuple[Any, Any], strange_definitions: str) -> None:
    """It comes along, waited for from before it is there."""
    here, there = hosts
    process = there.spawn("listener", "strange_thing", "--timeout", "20", "--json")
    here.spawn("pub", "strange_thing", '{"label": "hi"}', "--hold", "20", UORB_MSG_PATH=strange_definitions)
    output, errors = process.communicate(timeout=20)
    assert process.returncode == 0, errors
    assert json.loads(output)["message"]["label"] == "hi"


def test_verbs_carry_their_own_link(shell: Any, far: Any, endpoint: str, strange_definitions: str) -> None:
    """No daemon on this host: ls, top, listener and pub reach the other one by themselves."""
    publication = far.broker().advertise(SensorAccel, SensorAccel(timestamp=1, x=0.5))
    far.spawn("pub", "vehicle_attitude", '{"extra": 4}', "--hold", "50", UORB_MSG_PATH=strange_definitions)
    ready(far.spawn("start", "--host", "autopilot", "--listen", endpoint))
    link = ("--connect", endpoint, "--host", "ground")

    listed = shell.run("ls", "--json", *link)
    assert {(n["topic"], n["origin"]) for n in json.loads(listed.stdout)} == {
        ("sensor_accel", "autopilot"),
        ("vehicle_attitude", "autopilot"),
    }
    top = shell.run("top", "--once", "--json", *link)
    assert [row["origin"] for row in json.loads(top.stdout)] == ["autopilot"] * 2
    heard = shell.run("listener", "--connect", endpoint, "sensor_accel", "--host", "ground", "--timeout", "10")
    assert "x: 0.5" in heard.stdout
    assert heard.stderr == ""
    foreign = shell.run("listener", "vehicle_attitude", "--timeout", "10", *link)
    assert "extra: 4" in foreign.stdout
    publication.unadvertise()

    subscription = far.broker().subscribe(SensorAccel)
    sent = shell.run("pub", "sensor_accel", '{"x": 2}', "--hold", "0.5", *link)
    assert (sent.returncode, sent.stderr) == (0, "")
    assert subscription.lost == 0
    assert subscription.generation > 0


def test_nobody_at_the_endpoint_is_1(shell: Any, endpoint: str) -> None:
    """The listener waits its timeout and no longer."""
    done = shell.run("listener", "sensor_accel", "--connect", endpoint, "--timeout", "0.5")
    assert done.returncode == 1
    assert done.stderr.endswith("never published\n")


def test_a_file_gives_a_verb_its_link(shell: Any, far: Any, endpoint: str, tmp_path: Path) -> None:
    """`--config` with any verb."""
    path = tmp_path / "uorb.toml"
    path.write_text(f'connect = ["{endpoint}"]\nhost = "ground"\n')
    far.broker().advertise(VehicleAttitude, VehicleAttitude(timestamp=7))
    ready(far.spawn("start", "--listen", endpoint))
    done = shell.run("listener", "vehicle_attitude", "--config", str(path), "--timeout", "10")
    assert "timestamp: 7" in done.stdout


def test_start_logs_a_line_per_change(shell: Any, far: Any, endpoint: str) -> None:
    """A peer's coming and going, and its own end."""
    process = shell.spawn("start", "--listen", endpoint, "--host", "autopilot")
    ready(process)
    far.run("ls", "--connect", endpoint, "--host", "ground")
    assert "peer: ground is up" in process.stderr.readline()
    assert "peer: ground is down" in process.stderr.readline()
    process.terminate()
    assert "stopping" in process.stderr.readline()


def test_an_unreachable_endpoint_is_one_line(shell: Any, endpoint: str) -> None:
    """It is named, once, and the link goes on trying."""
    process = shell.spawn("start", "--connect", endpoint, "--host", "lonely")
    assert "connects to" in process.stderr.readline()
    line = process.stderr.readline()
    assert "no host reached yet" in line
    assert endpoint in line
    process.terminate()
    assert "is stopping" in process.stderr.readline()
    assert process.wait(5) == 0
