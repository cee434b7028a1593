"""The command `uorb VERB`: finds the verb's module, runs it, turns errors into one line and a status.

Only the verb in use is imported. Status: 0 success, 1 nothing to show or nobody there, 2 wrong usage or
unknown topic, 130 after Ctrl-C; SIGTERM ends any verb with 0, a closed pipe quietly.
"""

import os
import signal
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from importlib import import_module
from threading import current_thread, main_thread
from types import FrameType, ModuleType
from typing import Any, NoReturn

from .. import __version__
from ..errors import UnknownTopicError, UorbError

VERBS = {
    "start": "run this host's link to other hosts in the foreground",
    "ls": "list the topics of the bus",
    "top": "show rates, losses and readers, once a second",
    "listener": "print samples of a topic",
    "pub": "publish a message given as JSON",
    "play": "play a ULog file onto the bus",
    "test": "test the bus of this machine",
    "demo": "show a vehicle of two hosts on this machine",
}
EXAMPLES = """examples:
  uorb ls
  uorb listener sensor_accel 5
  uorb top --connect tcp/192.168.1.10:7447
  uorb VERB --help"""


class UsageError(Exception):
    """The command line cannot be followed; the text says what to write instead."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command and return its exit status; `argv` without the program's name."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    name = "uorb"
    with _signals(ending=argv is None):
        try:
            verb, rest = split(arguments)
            name = f"uorb {verb}" if verb else name
            status = _run(verb, rest) if verb else _overview(rest)
        except SystemExit as stop:
            status = stop.code if isinstance(stop.code, int) else 0
        except KeyboardInterrupt:
            status = 130
        except BrokenPipeError:
            _mute()
            status = 0
        except (UsageError, UnknownTopicError) as error:
            status = complain(name, error, 2)
        except (UorbError, OSError) as error:
            status = complain(name, error)
        return _flushed(name, status)


def split(arguments: Sequence[str]) -> tuple[str, list[str]]:
    """Return the verb, which options may precede, and all that is not the verb; "" without one."""
    for index, argument in enumerate(arguments):
        if argument in VERBS and (index == 0 or arguments[0].startswith("-")):
            return argument, [*arguments[:index], *arguments[index + 1 :]]
    return "", list(arguments)


def complain(name: str, error: object, status: int = 1) -> int:
    """Say in one line what is wrong, and return the status."""
    text = str(error)
    if isinstance(error, OSError) and error.strerror:
        text = f"{error.filename}: {error.strerror}" if error.filename else error.strerror
    with suppress(OSError):
        print(f"{name}: {' '.join(text.split())}", file=sys.stderr, flush=True)
    return status


def _overview(arguments: list[str]) -> int:
    if "--version" in arguments:
        print(f"uorb {__version__}")
    elif arguments[:1] in (["-h"], ["--help"]):
        width = max(map(len, VERBS))
        print("usage: uorb VERB ...\n\nThe bus of this host, and of those linked with it.\n")
        print("\n".join(f"  {verb:<{width}}  {text}" for verb, text in VERBS.items()))
        print(f"\n{EXAMPLES}")
    else:
        raise UsageError(f"{_objection(arguments)}; see uorb --help")
    return 0


def _objection(arguments: list[str]) -> str:
    given = next((a for a in arguments if not a.startswith("-")), None)
    if given is None:
        return f"say what to do: one of {', '.join(VERBS)}"
    from difflib import get_close_matches

    near = get_close_matches(given, VERBS)
    hint = f"did you mean {near[0]}?" if near else f"there are {', '.join(VERBS)}"
    return f"no verb {given!r}: {hint}"


def _run(verb: str, arguments: list[str]) -> int:
    from .options import Parser, endpoints_apart

    module: Any = _module(verb)
    parser = Parser(prog=f"uorb {verb}")
    module.add(parser)
    return int(module.run(parser.parse_args(endpoints_apart(arguments))))


def _module(verb: str) -> ModuleType:
    if verb != "demo":
        return import_module(f"{__name__}.{verb}")
    try:
        return import_module("uorb_net.demo.command")
    except ModuleNotFoundError as error:
        if not (error.name or "").startswith("uorb_net.demo"):
            raise
        raise UorbError("this installation has no demo: install the whole package uorb-net") from None


@contextmanager
def _signals(*, ending: bool) -> Iterator[None]:
    """Let SIGTERM end the verb as a success; `ending`: the process ends after this, quietly."""
    if current_thread() is not main_thread():
        yield
        return
    before = signal.signal(signal.SIGTERM, _terminate)
    try:
        yield
    finally:
        if ending:  # what comes now is the interpreter's end: a second signal has nothing to add
            signal.signal(signal.SIGINT, signal.SIG_IGN)
        signal.signal(signal.SIGTERM, signal.SIG_IGN if ending else before)


def _terminate(number: int, frame: FrameType | None) -> NoReturn:
    raise SystemExit(0)


def _flushed(name: str, status: int) -> int:
    """Write out what is buffered while errors can still be told."""
    if sys.stdout is None:  # started with standard output closed
        return status
    try:
        sys.stdout.flush()
    except BrokenPipeError:
        _mute()
    except OSError as error:
        _mute()
        return complain(name, error)
    return status


def _mute() -> None:
    """Send what is still buffered nowhere, so that the interpreter's last flush does not complain."""
    with suppress(OSError, ValueError):
        null = os.open(os.devnull, os.O_WRONLY)
        os.dup2(null, sys.stdout.fileno())
        os.close(null)
