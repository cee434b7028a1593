"""Finds the messages in a ULog's bytes, also behind damage.

A message is believed when its body fits its kind. A body that does not, in a frame that the next
header confirms, is stepped over; otherwise the search goes on byte by byte until a fitting message
is followed by another header. It holds one message and one buffer.
"""

import re
import struct
from collections.abc import Callable
from typing import BinaryIO

HEADER = struct.Struct("<HB")
BUFFER_BYTES = 1 << 16
SYNC = b"\x2f\x73\x13\x20\x25\x0c\xbb\x12"

# The bytes of a body that decide whether it fits its kind: length bytes, and 255 they may count.
_HEAD = 260
# pyulog's bound: what claims to be longer and is of no known kind counts as damage.
_SANE_SIZE = 10_000

_DATA = ord("D")
_KINDS = b"ABCDFILMOPQRS"
_CANDIDATE = re.compile(rb"(?=..[" + _KINDS + rb"])", re.DOTALL)
_TOPIC = re.compile(rb"[A-Za-z0-9_\-/]+")
_KEY = re.compile(rb"[A-Za-z0-9_]+(?:\[[0-9]+\])? [\x21-\x7e]+")
_FORMAT = re.compile(rb"[A-Za-z0-9_\-/]+:[A-Za-z0-9_\-/]+(?:\[[0-9]+\])? ")
# No control characters but white space and escape; NULs only to fill up the end.
_TEXT = re.compile(rb"[\x09-\x0d\x1b\x20-\xff]*\x00*")

RowFits = Callable[[bytes, int], bool]
"""Whether a data message that begins with these bytes may have this size."""


class Frames:
    """The messages of an open file, front to end.

    Attributes:
        at: offset of the message pulled last.
        position: offset of the next message.
        truncated, faults, problem: as in ``ULogReader``.
    """

    def __init__(self, file: BinaryIO, row_fits: RowFits) -> None:
        """Start at the file's beginning; ``row_fits`` is asked about every data message."""
        self.at = self.position = 0
        self.truncated, self.faults, self.problem = False, 0, ""
        self._file = file
        self._row_fits = row_fits

    def go(self, position: int) -> None:
        """Continue at this offset."""
        self._file.seek(position)
        self.position = position

    def fault(self, at: int, what: str) -> None:
        """Count a fault; the first one is kept as the problem."""
        self.faults += 1
        self.problem = self.problem or f"byte {at}: {what}"

    def cut(self, at: int, end: int) -> None:
        """Note that a section ends inside the message at ``at``, and go to its end."""
        self.truncated = True
        self.fault(at, "the log ends inside a message")
        self.go(end)

    def pull(self, end: int) -> tuple[int, bytes] | None:
        """Return kind and body of the next message before offset ``end``, None if there is no more."""
        while (at := self.position) < end:
            header = self._file.read(HEADER.size) if end - at >= HEADER.size else b""
            if len(header) < HEADER.size:
                self.cut(at, end)
                break
            size, kind = HEADER.unpack(header)
            body = self._file.read(min(size, end - at - HEADER.size))
            fits = self._fits(kind, size, body)
            if len(body) == size and fits:
                self.at, self.position = at, at + HEADER.size + size
                return kind, body
            if len(body) == size:
                self._step_over(kind, size, end)
            elif fits or not self._recover(end):
                self.cut(at, end)
        return None

    def _step_over(self, kind: int, size: int, end: int) -> None:
        """Deal with a whole message that does not fit its kind, or is of no known kind."""
        at, after = self.position, self.position + HEADER.size + size
        if 0 < size <= _SANE_SIZE and self._framed(after, end):
            # An unknown kind in an intact frame is a newer writer's, and no fault.
            if kind in _KINDS:
                self.fault(at, f"the {chr(kind)!r} message is damaged or of no known series")
            self.go(after)
        elif not self._recover(end):
            self.fault(at, "damaged, and nothing readable after it")
            self.go(end)

    def _recover(self, end: int) -> bool:
        """Go to the next believable message behind the present one; False, and no move, without one."""
        at = self.position
        found = self._search(at + 1, end)
        if found is None:
            return False
        self.fault(at, f"{found - at} damaged bytes skipped")
        self.go(found)
        return True

    def _search(self, at: int, end: int) -> int | None:
        while end - at >= HEADER.size:
            self._file.seek(at)
            window = self._file.read(min(BUFFER_BYTES, end - at))
            for match in _CANDIDATE.finditer(window):
                if self._believable(window, match.start(), at, end):
                    return at + match.start()
            # The windows overlap by what a candidate at the edge needs to be judged.
            if len(window) <= HEADER.size + _HEAD:
                break
            at += len(window) - HEADER.size - _HEAD
        return None

    def _believable(self, window: bytes, i: int, at: int, end: int) -> bool:
        """Whether a fitting message starts at ``i`` in the window read at ``at``, and one follows it."""
        size, kind = HEADER.unpack_from(window, i)
        body = i + HEADER.size
        if at + body + size > end:
            return False
        head = window[body : body + min(size, _HEAD)]
        return self._fits(kind, size, head) and self._framed(at + body + size, end)

    def _framed(self, at: int, end: int) -> bool:
        """Whether the section ends at this offset, or the header of a known kind stands there."""
        self._file.seek(at)
        header = self._file.read(min(HEADER.size, end - at))
        if len(header) < HEADER.size:
            return True
        size, kind = HEADER.unpack(header)
        return kind in _KINDS and 0 < size <= _SANE_SIZE

    def _fits(self, kind: int, size: int, body: bytes) -> bool:
        """Whether a body, of which the first bytes are enough, can be of this kind and size."""
        if kind == _DATA:
            return self._row_fits(body, size)
        if kind in b"IP":
            return _fits_key(body, size)
        if kind in b"MQ":
            return _fits_key(body[1:], size - 1)
        if kind in b"LC":
            return _fits_text(body, size, 9 if kind == ord("L") else 11)
        if kind == ord("F"):
            return _FORMAT.match(body) is not None
        if kind == ord("A"):
            return size > 3 and _TOPIC.fullmatch(body, 3) is not None
        if kind == ord("S"):
            return body == SYNC
        if kind == ord("B"):
            return size >= 40 and body[8:9] in (b"\0", b"\1") and body[9:16] == bytes(7)
        return size == 2 and kind in b"OR"


def _fits_key(body: bytes, size: int) -> bool:
    """Whether a body begins with a length byte and that many bytes of ``type name``."""
    length = body[0] if body else 0
    return 0 < length < size and _KEY.fullmatch(body, 1, 1 + length) is not None


def _fits_text(body: bytes, size: int, text_at: int) -> bool:
    return size >= text_at and body[:1] in _LEVELS and _TEXT.fullmatch(body, text_at) is not None


_LEVELS = tuple(bytes([level]) for level in b"01234567")
