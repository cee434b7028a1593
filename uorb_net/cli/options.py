"""Flags that mean the same with every verb, and the checks of what they are given."""

import argparse
import math
from collections.abc import Sequence
from typing import NoReturn

from . import UsageError

INSTANCES = 10  # of a topic, see uorb_net.broker.members
MODES = ("peer", "client", "router")
_ENDPOINTS = ("--connect", "--listen")


class Parser(argparse.ArgumentParser):
    """A parser whose errors are one line."""

    def __init__(self, prog: str) -> None:
        super().__init__(prog=prog, allow_abbrev=False, formatter_class=argparse.RawDescriptionHelpFormatter)

    def describe(self, text: str, *examples: str) -> None:
        """Set what the help says first and last."""
        self.description = text
        self.epilog = "\n".join(["examples:", *(f"  {example}" for example in examples)])

    def error(self, message: str) -> NoReturn:
        """Raise UsageError instead of printing the usage."""
        raise UsageError(f"{message}; see {self.prog} --help")


def add_common(parser: argparse.ArgumentParser) -> None:
    """Add the flags that say which bus is meant, and give the verb its own link."""
    group = parser.add_argument_group("bus and network")
    group.add_argument("--vehicle", metavar="NAME", help="the vehicle's bus ($UORB_VEHICLE, else default)")
    group.add_argument("--host", metavar="NAME", help="this host's name on its link ($UORB_HOST)")
    for flag, what in zip(_ENDPOINTS, ("reach another host at", "accept other hosts at")):
        group.add_argument(
            flag,
            metavar="ENDPOINT",
            action="append",
            default=[],
            help=f"{what} these, such as tcp/192.168.1.10:7447; the verb carries its own link",
        )
    group.add_argument("--mode", choices=MODES, help="how the link joins the network (peer)")
    group.add_argument("--config", metavar="FILE", help="a TOML file with the link's settings")


def endpoints_apart(arguments: Sequence[str]) -> list[str]:
    """Repeat --connect and --listen before each of their endpoints.

    With argparse's own `nargs="+"`, `--connect ENDPOINT TOPIC` would take the topic for an endpoint.
    """
    if not any(flag in arguments for flag in _ENDPOINTS):
        return list(arguments)
    from communicator.endpoints import PROTOCOLS

    apart: list[str] = []
    flag, fresh = "", False
    for argument in arguments:
        if argument in _ENDPOINTS:
            flag, fresh = argument, True
        elif fresh:  # the flag's own value, whatever it is
            fresh = False
        elif flag and argument.partition("/")[0] in PROTOCOLS:
            apart.append(flag)
        else:
            flag = ""
        apart.append(argument)
    return apart


def instance(text: str) -> int:
    """Take an instance number."""
    return _integer(text, "an instance", 0, INSTANCES - 1)


def count(text: str) -> int:
    """Take a number of samples."""
    return _integer(text, "a number of samples", 1, None)


def _integer(text: str, what: str, low: int, high: int | None) -> int:
    try:
        value = int(text)
    except ValueError:
        value = low - 1
    if value < low or (high is not None and value > high):
        bounds = f"{low} or more" if high is None else f"{low}..{high}"
        raise argparse.ArgumentTypeError(f"{text!r} is not {what}: {bounds}")
    return value


def rate(text: str) -> float:
    """Take a rate in Hz, above 0."""
    value = _number(text)
    if not 0 < value <= 1e6:
        raise argparse.ArgumentTypeError(f"{text!r} is not a rate: samples a second, above 0")
    return value


def speed(text: str) -> float:
    """Take a factor of real time, 0 or more."""
    value = _number(text)
    if not value >= 0:
        raise argparse.ArgumentTypeError(f"{text!r} is not a rate: 1 is real time, 0 as fast as possible")
    return value


def seconds(text: str) -> float:
    """Take a duration, 0 or more."""
    value = _number(text)
    if not value >= 0:
        raise argparse.ArgumentTypeError(f"{text!r} is not a duration: seconds, 0 or more")
    return value


def _number(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        return -1.0
    return value if math.isfinite(value) else -1.0
