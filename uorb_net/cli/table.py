"""Aligned columns of text."""

from collections.abc import Iterable, Sequence
from typing import NamedTuple


class Column(NamedTuple):
    """A column's heading, and which side its cells keep to."""

    heading: str
    right: bool = True


def table(columns: Sequence[Column], rows: Iterable[Sequence[object]]) -> list[str]:
    """Return the lines of a table: the headings, then the rows, each column as wide as it must be."""
    cells = [[str(cell) for cell in row] for row in rows]
    widths = [max([len(column.heading), *(len(row[i]) for row in cells)]) for i, column in enumerate(columns)]

    def line(row: Sequence[str]) -> str:
        parts = [
            cell.rjust(width) if column.right else cell.ljust(width)
            for cell, width, column in zip(row, widths, columns)
        ]
        return " ".join(parts).rstrip()

    return [line([column.heading for column in columns]), *map(line, cells)]
