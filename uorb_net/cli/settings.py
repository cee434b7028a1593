"""What a link is made of: a TOML file's keys, overruled by flags."""

import argparse
import os
from typing import Annotated, Any

import msgspec

from . import UsageError

DEFAULT_LISTEN = "tcp/127.0.0.1:7447"


class TrafficClass(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A table `[classes.NAME]`: patterns of topics, 1 (first) to 7, Hz, whether losses are asked for."""

    topics: list[str] | msgspec.UnsetType = msgspec.UNSET
    priority: Annotated[int, msgspec.Meta(ge=1, le=7)] | msgspec.UnsetType = msgspec.UNSET
    max_rate: Annotated[float, msgspec.Meta(gt=0)] | msgspec.UnsetType = msgspec.UNSET
    resend: bool | msgspec.UnsetType = msgspec.UNSET


class Tls(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The table `[tls]`: files, relative to the one that names them."""

    ca: str
    certificate: str
    key: str


class Settings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """All keys of the file."""

    host: str | None = None
    vehicle: str | None = None
    listen: list[str] = []
    connect: list[str] = []
    mode: str = "peer"
    lease: float = 2.0
    observer: bool = False
    tls: Tls | None = None
    classes: dict[str, TrafficClass] = {}

    @property
    def endpoints(self) -> str:
        """Where the link is, in words."""
        parts = [f"listens on {', '.join(self.listen)}"] if self.listen else []
        parts += [f"connects to {', '.join(self.connect)}"] if self.connect else []
        return " and ".join(parts)


def carries_link(args: argparse.Namespace) -> bool:
    """Tell whether the flags give the verb its own link."""
    return bool(args.connect or args.listen or args.mode or args.config)


def settings(args: argparse.Namespace) -> Settings:
    """Return the settings of `--config`, overruled by the other flags.

    Raises:
        UsageError: the file has an unknown key or a wrong value; the error names it.
        OSError: the file cannot be read.
    """
    chosen = read(args.config) if args.config else Settings()
    flags: dict[str, Any] = {name: getattr(args, name) for name in ("host", "vehicle", "mode")}
    if args.connect or args.listen:  # the flags' endpoints replace the file's, both kinds together
        flags |= {"connect": args.connect, "listen": args.listen}
    chosen = msgspec.structs.replace(chosen, **{k: v for k, v in flags.items() if v is not None})
    if not (chosen.connect or chosen.listen) and chosen.mode != "client":
        chosen = msgspec.structs.replace(chosen, listen=[DEFAULT_LISTEN])
    return chosen


def read(path: str) -> Settings:
    """Read a file; raises as `settings`."""
    import tomllib

    with open(path, "rb") as file:
        try:
            table = tomllib.load(file)
        except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
            raise UsageError(f"{path} is not TOML: {error}") from error
    try:
        found = msgspec.convert(table, Settings)
    except msgspec.ValidationError as error:
        keys = ", ".join(Settings.__struct_fields__)
        raise UsageError(f"{path}: {error}; keys are {keys}, see docs/tools.md") from error
    if found.observer:
        raise UsageError(f"{path}: observer = true is not available in this version: remove the line")
    return found if found.tls is None else msgspec.structs.replace(found, tls=_beside(path, found.tls))


def _beside(path: str, tls: Tls) -> Tls:
    folder = os.path.dirname(os.path.abspath(path))
    return Tls(*(os.path.join(folder, file) for file in (tls.ca, tls.certificate, tls.key)))
