"""What all verbs share: help, versions, errors in one line, signals, closed pipes, and starting fast."""

import signal
import subprocess
import sys
from typing import Any

import pytest

import uorb_net
from uorb_net.cli import VERBS, split
from uorb_net.cli.options import endpoints_apart
from uorb_net.msg import SensorAccel

OWN = [verb for verb in VERBS if verb != "demo"]


def test_version_and_overview(shell: Any) -> None:
    """`--version` names the version, `--help` every verb."""
    version = shell.run("--version")
    assert (version.returncode, version.stdout) == (0, f"uorb {uorb_net.__version__}\n")
    overview = shell.run("--help")
    assert overview.returncode == 0
    assert all(f"  {verb} " in overview.stdout for verb in VERBS)


@pytest.mark.parametrize("verb", OWN)
def test_every_verb_has_help_with_an_example(shell: Any, verb: str) -> None:
    """An example starts as a user types it."""
    status, output, errors = shell.run_here(verb, "--help")
    assert (status, errors) == (0, "")
    assert f"\n  uorb {verb} " in output or f"\n  uorb {verb}\n" in output
    common = ("--vehicle", "--connect", "--listen", "--mode", "--config")
    assert verb == "test" or all(flag in output for flag in common), "the self test has a bus of its own"


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ((), "say what to do"),
        (("listner",), "did you mean listener?"),
        (("--vehicle", "x"), "no verb"),
        (("ls", "--bogus"), "--bogus"),
        (("listener",), "TOPIC"),
        (("listener", "sensor_accel", "0"), "number of samples"),
        (("listener", "sensor_accel", "-i", "10"), "0..9"),
        (("listener", "sensor_accel", "-r", "nan"), "rate"),
        (("listener", "sensor_accel", "--timeout", "-1"), "seconds"),
        (("play", "x.ulg", "--rate", "-1"), "real time"),
        (("ls", "--vehicle", "../up"), "--vehicle"),
        (("ls", "--mode", "tree"), "--mode"),
        (("ls", "--mode", "client"), "router"),
        (("ls", "--connect", "127.0.0.1:7447"), "write tcp/"),
    ],
)
def test_wrong_usage_is_2_in_one_line(shell: Any, arguments: tuple[str, ...], said: str) -> None:
    """The line says what is wrong, on standard error."""
    status, output, errors = shell.run_here(*arguments)
    assert (status, output) == (2, "")
    assert errors.count("\n") == 1
    assert said in errors


def test_an_unusable_runtime_directory_is_one_line(shell: Any, tmp_path: Any) -> None:
    """A file where the folder should be."""
    (tmp_path / "file").write_text("")
    done = shell.run("ls", UORB_RUNTIME_DIR=str(tmp_path / "file"))
    assert done.returncode == 1
    assert done.stderr.count("\n") == 1
    assert "UORB_RUNTIME_DIR" in done.stderr


def test_options_may_precede_the_verb() -> None:
    """`uorb --vehicle uav1 ls` is `uorb ls --vehicle uav1`."""
    assert split(["--vehicle", "uav1", "ls", "--json"]) == ("ls", ["--vehicle", "uav1", "--json"])
    assert split(["listener", "ls"]) == ("listener", ["ls"])
    assert split(["nothing", "ls"])[0] == ""


def test_endpoints_end_where_other_arguments_begin() -> None:
    """A topic behind the endpoints is no endpoint."""
    given = ["--connect", "tcp/a:1", "udp/b:2", "sensor_accel", "tcp/c:3", "--listen", "tcp/d:4", "-i", "1"]
    assert endpoints_apart(given) == [
        *("--connect", "tcp/a:1", "--connect", "udp/b:2", "sensor_accel", "tcp/c:3"),
        *("--listen", "tcp/d:4", "-i", "1"),
    ]
    assert endpoints_apart(["--connect", "wrong", "topic"]) == ["--connect", "wrong", "topic"]


@pytest.mark.parametrize("verb", ["ls", "top --once", "listener sensor_accel", "pub sensor_accel {} --hold 0"])
def test_verbs_without_a_network_import_none(shell: Any, verb: str) -> None:
    """Neither Zenoh nor asyncio is loaded where nothing needs it."""
    code = (
        "import sys; from uorb_net.cli import main; main(sys.argv[1:]); "
        "print([m for m in sys.modules if m.split('.')[0] in ('zenoh', 'asyncio', 'communicator')])"
    )
    shell.broker().advertise(SensorAccel, SensorAccel())
    done = subprocess.run(
        [sys.executable, "-c", code, *verb.split()],
        env=shell.environment(),
        capture_output=True,
        text=True,
        timeout=30,
        check=True,
    )
    assert done.stdout.splitlines()[-1] == "[]"


LONG = [
    "listener sensor_accel -n 1000000 --timeout 60",
    "pub sensor_accel {} -r 50",
    "top",
    "start --listen ENDPOINT",
]


@pytest.mark.parametrize(("number", "status"), [(signal.SIGINT, 130), (signal.SIGTERM, 0)])
@pytest.mark.parametrize("line", LONG)
def test_signals_end_a_verb_at_once(shell: Any, endpoint: str, line: str, number: signal.Signals, status: int) -> None:
    """Ctrl-C is 130, SIGTERM 0, within 2 s and without a traceback."""
    broker = shell.broker()
    publication = broker.advertise(SensorAccel, SensorAccel())
    process = shell.spawn(*line.replace("ENDPOINT", endpoint).split())
    if line.startswith("pub"):
        assert shell.until(lambda: broker.topics()[0].publishers == 2)
    else:  # it has begun once it has said something
        publication.publish(SensorAccel())
        stream = process.stderr if line.startswith("start") else process.stdout
        assert stream.readline()
    process.send_signal(number)
    _, errors = process.communicate(timeout=2.0)
    assert process.returncode == status
    assert "Traceback" not in errors
    assert "Exception" not in errors


@pytest.mark.parametrize("line", ["listener sensor_accel -n 1000000 --timeout 60", "top -a", "ls --json"])
def test_a_closed_pipe_is_quiet(shell: Any, line: str) -> None:
    """`uorb ... | head -1` ends by itself and complains of nothing."""
    publication = shell.broker().advertise(SensorAccel, SensorAccel())
    process = shell.spawn(*line.split())
    assert process.stdout.readline()
    process.stdout.close()
    assert shell.until(lambda: publication.publish(SensorAccel()) or process.poll() is not None)
    assert process.returncode == 0
    assert process.stderr.read() == ""


def test_a_full_disk_is_one_line(shell: Any) -> None:
    """What cannot be written is an error, not silence."""
    shell.broker().advertise(SensorAccel, SensorAccel())
    with open("/dev/full", "w", encoding="utf-8") as full:
        done = subprocess.run(
            [sys.executable, "-m", "uorb_net.cli", "ls"],
            env=shell.environment(),
            stdout=full,
            stderr=subprocess.PIPE,
            text=True,
            timeout=30,
            check=False,
        )
    assert done.returncode == 1
    assert done.stderr == "uorb ls: No space left on device\n"
