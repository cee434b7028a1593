"""What a measurement is here: a ratio to a control, alternating round by round, the median of the rounds.

Absolute times depend on the machine and the minute; they are shown beside the ratio, and never compared.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from math import inf
from statistics import median
from time import perf_counter

Timed = Callable[[int], float]


@dataclass(frozen=True)
class Measured:
    """Medians over the rounds: ours divided by the control, and microseconds per operation of each."""

    ratio: float
    ours_us: float
    control_us: float


@dataclass(frozen=True)
class Row:
    """One line of a report; the goal is met when ``ratio <= goal``."""

    name: str
    ratio: float
    goal: float
    ours_us: float
    control_us: float
    remark: str = ""

    @property
    def met(self) -> bool:
        """True if the goal is met."""
        return self.ratio <= self.goal


def alternate(ours: Timed, control: Timed, rounds: int, n: int) -> Measured:
    """Measure two operations in alternating rounds.

    Args:
        ours: does what is measured ``n`` times and returns the seconds it took.
        control: the same for what it is compared with.
        rounds: rounds, after one that does not count; every other one starts with the control.
        n: operations per round and side.
    """
    ours(n), control(n)
    pairs: list[tuple[float, float]] = []
    for index in range(rounds):
        if index % 2:
            other = control(n)
            pairs.append((ours(n), other))
        else:
            pairs.append((ours(n), control(n)))
    microseconds = 1e6 / n
    return Measured(
        median(a / b for a, b in pairs),
        median(a for a, _ in pairs) * microseconds,
        median(b for _, b in pairs) * microseconds,
    )


def row(name: str, measured: Measured, goal: float, remark: str = "") -> Row:
    """Make a line of the report."""
    return Row(name, measured.ratio, goal, measured.ours_us, measured.control_us, remark)


def timed(operation: Callable[[int], object]) -> Timed:
    """Make a function that does something ``n`` times one that also says how long it took."""

    def run(n: int) -> float:
        start = perf_counter()
        operation(n)
        return perf_counter() - start

    return run


def count_for(operation: Timed, seconds: float) -> int:
    """Return how many operations take about so many seconds."""
    n = 1
    while (taken := operation(n)) < seconds / 10 and n < 10**9:
        n *= 4
    return max(1, int(n * seconds / taken))


def print_table(rows: Iterable[Row]) -> None:
    """Print rows, aligned."""
    cells = [("", "ratio", "goal", "", "ours us", "control us", "")]
    for line in rows:
        verdict = "ok" if line.met else "MISSED"
        numbers = (
            f"{line.ratio:.3f}",
            f"{line.goal:.3f}" if line.goal < inf else "",
            verdict if line.goal < inf else "",
            f"{line.ours_us:.3f}",
            f"{line.control_us:.3f}",
        )
        cells.append((line.name, *numbers, line.remark))
    widths = [max(map(len, column)) for column in zip(*cells)]
    for cell in cells:
        texts = (
            text.rjust(width) if 0 < i < 6 else text.ljust(width) for i, (text, width) in enumerate(zip(cell, widths))
        )
        print("  ".join(texts).rstrip())
