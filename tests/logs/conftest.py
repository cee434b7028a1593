"""Writes small ULog files, byte by byte, for the tests of this directory."""

import struct
from collections.abc import Callable

import pytest

MAGIC = b"ULog\x01\x12\x35"
SYNC = b"\x2f\x73\x13\x20\x25\x0c\xbb\x12"


def _body(kind: str, *parts: object) -> bytes:
    """Return a body: text as it is, numbers by the kind's layout, bytes untouched."""
    layouts = {"A": "<BH", "D": "<H", "O": "<H", "R": "<H", "L": "<BQ", "C": "<BHQ", "M": "<B", "Q": "<B"}
    numbers = [part for part in parts if isinstance(part, int)]
    body = struct.pack(layouts.get(kind, "<"), *numbers)
    for part in parts:
        if isinstance(part, str):
            body += (bytes([len(part)]) if kind in "IMPQ" else b"") + part.encode()
        elif isinstance(part, bytes):
            body += part
    return body


def _message(kind: str, *parts: object) -> bytes:
    body = _body(kind, *parts)
    return struct.pack("<HB", len(body), ord(kind)) + body


@pytest.fixture(scope="session")
def message() -> Callable[..., bytes]:
    """Build one message: kind, then its numbers in order, text or key, and raw bytes.

    ``("A", instance, msg_id, topic)``, ``("D", msg_id, row)``, ``("L", level, timestamp, text)``,
    ``("F", text)``, ``("I", "int32_t key", value)``, ``("M", continued, "char[3] key", value)``.
    """
    return _message


@pytest.fixture(scope="session")
def make_log() -> Callable[..., bytes]:
    """Build a log from messages, each a tuple for ``message`` or bytes put in as they are."""

    def build(*messages: tuple[str, *tuple[object, ...]] | bytes, start_us: int = 1_000_000, version: int = 1) -> bytes:
        header = MAGIC + struct.pack("<BQ", version, start_us)
        return header + b"".join(m if isinstance(m, bytes) else _message(*m) for m in messages)

    return build


@pytest.fixture(scope="session")
def sync() -> bytes:
    """A whole sync message."""
    return _message("S", SYNC)
