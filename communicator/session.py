"""The one place where a Zenoh session is configured and opened."""

import json
import logging
import math
import os
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from communicator.channel import ChannelError
from communicator.endpoints import ENCRYPTED, Endpoint, parse_endpoints, without_own
from communicator.wire import MAX_FRAME

if TYPE_CHECKING:
    import zenoh

log = logging.getLogger(__name__)

MODES = ("peer", "client", "router")
_TLS_KEYS = ("ca", "certificate", "key")
_CLIENT_OPEN_MS = 1500  # an open cannot be interrupted, and stop() has 2 s; slow links need several round trips
_FRAME_SLACK = 64 << 10  # what Zenoh adds to a frame: the key and its own headers


@dataclass(frozen=True, slots=True)
class SessionOptions:
    """Checked options of a session."""

    listen: tuple[Endpoint, ...] = ()
    connect: tuple[Endpoint, ...] = ()
    mode: str = "peer"
    lease: float = 2.0
    tls: Mapping[str, str] | None = None
    multicast: bool = False
    config: Mapping[str, object] = field(default_factory=dict)


def check_options(
    *,
    listen: Iterable[str],
    connect: Iterable[str],
    mode: str,
    lease: float,
    tls: Mapping[str, str | os.PathLike[str]] | None,
    multicast: bool,
    config: Mapping[str, object] | None,
) -> SessionOptions:
    """Check a channel's options before anything is opened.

    Raises:
        ChannelError: an option is wrong; the message says which and how it is written.
    """
    if mode not in MODES:
        raise ChannelError(f"mode {mode!r}: use one of {', '.join(MODES)}")
    if not (math.isfinite(lease) and 0.1 <= lease <= 3600):
        raise ChannelError(f"lease {lease!r}: use seconds from 0.1 to 3600")
    listening, connecting = parse_endpoints("listen", listen), parse_endpoints("connect", connect)
    if mode == "client" and listening:
        raise ChannelError("a client does not listen: leave listen empty, or use mode='peer' or 'router'")
    if mode == "client" and not connecting and not multicast:
        raise ChannelError("a client needs its router's endpoint in connect")
    merged = _checked_config(config)
    files = _checked_tls(tls, (*listening, *connecting), merged)
    return SessionOptions(listening, without_own(connecting, listening), mode, float(lease), files, multicast, merged)


def _checked_config(config: Mapping[str, object] | None) -> Mapping[str, object]:
    if config is None:
        return {}
    if not isinstance(config, Mapping):
        raise ChannelError("config is a nested mapping of Zenoh's configuration")
    try:
        return dict(json.loads(json.dumps(dict(config))))
    except (TypeError, ValueError) as error:
        raise ChannelError(f"config cannot be written as JSON: {error}") from error


def _checked_tls(
    tls: Mapping[str, str | os.PathLike[str]] | None,
    endpoints: Iterable[Endpoint],
    config: Mapping[str, object],
) -> Mapping[str, str] | None:
    if tls is None:
        bare = [e.text for e in endpoints if e.protocol in ENCRYPTED]
        if bare and "transport" not in config:
            raise ChannelError(f"endpoint {bare[0]!r} needs tls=dict(ca=..., certificate=..., key=...)")
        return None
    if set(tls) != set(_TLS_KEYS):
        raise ChannelError(f"tls has the keys {', '.join(_TLS_KEYS)}, all of them; got {', '.join(map(str, tls))}")
    plain = [e for e in endpoints if e.protocol not in ENCRYPTED]
    if plain:
        raise ChannelError(f"endpoint {plain[0].text!r} is not encrypted: with tls write tls/... or quic/...")
    return {key: os.fspath(tls[key]) for key in _TLS_KEYS}


def build_config(options: SessionOptions, host: str) -> dict[str, Any]:
    """Return Zenoh's configuration as a nested mapping; the reasons of each value are in docs/wire.md."""
    client = options.mode == "client"
    transport: dict[str, Any] = {
        "unicast": {"open_timeout": 1000},
        "link": {
            "tx": {
                "lease": round(options.lease * 1000),
                "queue": {"congestion_control": {"block": {"wait_before_close": 300_000}}},
            },
            "rx": {"max_message_size": MAX_FRAME + _FRAME_SLACK},
        },
        "shared_memory": {"enabled": False},
    }
    if options.tls is not None:
        transport["link"] |= _tls_config(options.tls)
    ours: dict[str, Any] = {
        "mode": options.mode,
        "listen": {"endpoints": [e.text for e in options.listen]},
        "connect": {
            "endpoints": [e.text for e in options.connect],
            "timeout_ms": _CLIENT_OPEN_MS if client else -1,
            "exit_on_failure": client,
            "retry": {"period_init_ms": 200, "period_max_ms": 1000, "period_increase_factor": 2},
        },
        "scouting": {
            "multicast": {"enabled": options.multicast},
            "gossip": {"enabled": False},
            "delay": 0,
        },
        "transport": transport,
        "adminspace": {"enabled": True},
        "metadata": {"host": host},
    }
    return _merge(ours, options.config)


def _tls_config(tls: Mapping[str, str]) -> dict[str, Any]:
    return {
        "protocols": sorted(ENCRYPTED),
        "tls": {
            "root_ca_certificate": tls["ca"],
            "enable_mtls": True,
            "listen_certificate": tls["certificate"],
            "listen_private_key": tls["key"],
            "connect_certificate": tls["certificate"],
            "connect_private_key": tls["key"],
        },
    }


def _merge(base: Mapping[str, Any], over: Mapping[str, Any]) -> dict[str, Any]:
    merged = dict(base)
    for key, value in over.items():
        inner = merged.get(key)
        both = isinstance(inner, Mapping) and isinstance(value, Mapping)
        merged[key] = _merge(inner, value) if both else value  # type: ignore[arg-type]
    return merged


def check_files(options: SessionOptions) -> None:
    """Open each TLS file once, as Zenoh's own message does not name the one that is missing.

    Raises:
        ChannelError: one cannot be read.
    """
    for name, path in (options.tls or {}).items():
        try:
            with open(path, "rb"):
                pass
        except OSError as error:
            raise ChannelError(f"tls {name} {path!r}: {error.strerror}") from error


def zenoh_config(options: SessionOptions, host: str) -> "zenoh.Config":
    """Import Zenoh and make its configuration.

    $ZENOH_RUNTIME is left alone: one thread for all of Zenoh's work saves four, but with 20,000 tokens
    on the way it missed its keep-alives and lost the link; the default did not.

    Raises:
        ChannelError: Zenoh does not know an option of `config`, or a TLS file cannot be read.
    """
    import zenoh

    check_files(options)
    try:
        return zenoh.Config.from_json5(json.dumps(build_config(options, host)))
    except zenoh.ZError as error:
        raise ChannelError(f"Zenoh refuses the configuration: {error}") from error


def open_session(config: "zenoh.Config", options: SessionOptions) -> "zenoh.Session":
    """Open the session; a client blocks up to 1.5 s, the other modes some milliseconds.

    Raises:
        ChannelError: it cannot be opened, for example because a port is in use.
    """
    import zenoh

    try:
        return zenoh.open(config)
    except zenoh.ZError as error:
        raise ChannelError(_explain(str(error), options)) from error
    except BaseException as error:
        if type(error).__name__ != "PanicException":
            raise
        raise ChannelError(f"Zenoh failed to start; is $ZENOH_RUNTIME right? {error}") from error


def _explain(text: str, options: SessionOptions) -> str:
    guilty = [e.text for e in options.listen if e.text in text]
    where = guilty[0] if guilty else ", ".join(e.text for e in (*options.listen, *options.connect))
    if "Address already in use" in text:
        return f"cannot listen on {where}: the port is in use"
    return f"cannot open {where or 'a session'}: {text.split(' at /', maxsplit=1)[0]}"
