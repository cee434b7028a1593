"""Text that is drawn again and again: in place on a terminal, one after the other into a pipe."""

import os
import select
import sys
import time
from collections.abc import Sequence
from types import TracebackType
from typing import Any, Self

_HOME, _CLEAR, _CLEAR_LINE, _CLEAR_BELOW = "\x1b[H", "\x1b[2J", "\x1b[K", "\x1b[J"
_HIDE_CURSOR, _SHOW_CURSOR = "\x1b[?25l", "\x1b[?25h"


class Screen:
    """Standard output with the keys of standard input; a context manager that leaves both as they were."""

    def __init__(self) -> None:
        self.terminal = sys.stdout is not None and sys.stdout.isatty()
        self._keys = self.terminal and sys.stdin is not None and sys.stdin.isatty()
        self._drawn = False
        self._before: list[Any] = []

    def __enter__(self) -> Self:
        if self._keys:
            import termios
            import tty

            self._before = termios.tcgetattr(sys.stdin.fileno())
            tty.setcbreak(sys.stdin.fileno(), termios.TCSANOW)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._keys:
            import termios

            termios.tcsetattr(sys.stdin.fileno(), termios.TCSANOW, self._before)
        if self.terminal and self._drawn:
            sys.stdout.write(_SHOW_CURSOR)
            sys.stdout.flush()

    def draw(self, lines: Sequence[str]) -> None:
        """Show lines in place of those before; on a terminal no more than it has room for."""
        if self.terminal:
            # One write of a whole picture over the one before: nothing is ever blank, so nothing flickers.
            sys.stdout.write(picture(lines, os.get_terminal_size(sys.stdout.fileno()), first=not self._drawn))
        else:
            sys.stdout.write("".join(f"{line}\n" for line in ([""] if self._drawn else []) + [*lines]))
        sys.stdout.flush()
        self._drawn = True

    def wait(self, seconds: float) -> bool:
        """Wait so long; True as soon as q is pressed, or the keyboard is gone."""
        deadline = time.monotonic() + seconds
        while (left := deadline - time.monotonic()) > 0:
            if not self._keys:
                time.sleep(left)
            elif select.select([sys.stdin], [], [], left)[0] and os.read(sys.stdin.fileno(), 64) in _QUIT:
                return True
        return False


_QUIT = (b"q", b"Q", b"")


def picture(lines: Sequence[str], size: os.terminal_size, *, first: bool) -> str:
    """Return what draws lines over the former ones; the last line says what had no room."""
    room = (size.lines or 24) - 1 or 1  # a terminal that does not know its size says 0
    shown = list(lines)
    if len(shown) > room:
        shown = [
            *lines[: room - 1],
            f"... {len(lines) - room + 1} more: name some, or make the window larger",
        ]
    body = "".join(f"{line[: size.columns or 80]}{_CLEAR_LINE}\n" for line in shown)
    return f"{_HIDE_CURSOR + _CLEAR if first else ''}{_HOME}{body}{_CLEAR_BELOW}"
