"""From ULog's types and rows to .msg definitions and their encoding.

The fields keep the log's order, since the log's writer decided how the values lie. A row becomes
XCDR1 by copying byte ranges and inserting alignment: no value passes through a Python number, so
NaN payloads and every other bit survive.
"""

import keyword
import re
import struct
from collections.abc import Callable, Iterable, Iterator, Mapping

import msgspec

from uorb_net.logs.formats import PRIMITIVES, SIZES, Field, Format, Layout, measure
from uorb_net.logs.ulog import LogError

#: XCDR1, little endian: the encapsulation header of every encoded message.
HEADER = b"\x00\x01\x00\x00"

SEPARATOR = "=" * 80
_PACKAGE = "px4_msgs"
_RENAMED = {"float": "float32", "double": "float64", "bool": "bool", "char": "char"}
_TIMESTAMP = "timestamp"


class _Piece(msgspec.Struct):
    """``take`` row bytes from ``at``, after ``pad`` zero bytes of output."""

    at: int
    pad: int
    take: int


def type_names(formats: Iterable[str]) -> dict[str, str]:
    """Give each format name of a log its CamelCase type name, distinct within the log.

    ``sensor_combined`` becomes ``SensorCombined``. Where two names would meet (``a_1`` and ``a1``),
    the later one gets ``X2``, ``X3`` and so on.
    """
    names: dict[str, str] = {}
    used: set[str] = set()
    for name in formats:
        camel = _camel(name)
        names[name] = _free(camel, "X", used)
        used.add(names[name])
    return names


def _camel(name: str) -> str:
    words = re.split(r"[^A-Za-z0-9]+", name)
    camel = "".join(word[0].upper() + word[1:] for word in words if word)
    return camel if camel[:1].isalpha() and not keyword.iskeyword(camel) else "T" + camel


def topic_names(formats: Iterable[str]) -> dict[str, str]:
    """Give each format name of a log its topic: the name itself, wherever a topic may have it.

    ULog also allows ``-``, ``/`` and a digit in front; such names are mended as ``field_names`` does.
    """
    names = list(formats)
    return dict(zip(names, _distinct(names, _identifier), strict=True))


def field_names(fields: Iterable[Field]) -> list[str]:
    """Return the .msg names of a format's fields, one for each that is no padding.

    ULog allows names a definition cannot have. Other characters than letters, digits and ``_``
    become ``_``, leading underscores fall away, ``f_`` goes before what then begins with no letter,
    a Python keyword gets ``_`` behind it; a name then taken gets ``_2``, ``_3`` and so on.
    """
    return _distinct([field.name for field in fields if not field.is_padding], _attribute)


def _identifier(name: str) -> str:
    name = re.sub(r"[^A-Za-z0-9_]", "_", name).lstrip("_")
    return name if name[:1].isalpha() else "f_" + name


def _attribute(name: str) -> str:
    name = _identifier(name)
    return name + "_" if keyword.iskeyword(name) else name


def _distinct(names: list[str], mend: Callable[[str], str]) -> list[str]:
    """Mend names and keep them apart; a name that is good as it is never yields to a mended one."""
    used = {name for name in names if mend(name) == name}
    seen: set[str] = set()
    result = []
    for name in names:
        good = mend(name) == name and name not in seen
        result.append(name if good else _free(mend(name), "_", used))
        used.add(result[-1])
        seen.add(name)
    return result


def _free(name: str, joint: str, used: set[str]) -> str:
    candidate, n = name, 2
    while candidate in used:
        candidate, n = f"{name}{joint}{n}", n + 1
    return candidate


def definition_text(name: str, formats: Mapping[str, Format]) -> str:
    """Return the self-contained .msg text of the format called ``name``.

    Its own text first, then each nested type once, through all levels, behind a line of 80 ``=``
    and ``MSG: px4_msgs/Name``. Every part names its topic in a ``# TOPICS`` line.

    Raises:
        LogError: the format or a nested one is missing or cannot be laid out.
    """
    _measured(name, formats)
    types, topics = type_names(formats), topic_names(formats)
    text = _own_text(formats[name], types, topics)
    for nested in _nested(name, formats):
        text += f"{SEPARATOR}\nMSG: {_PACKAGE}/{types[nested]}\n"
        text += _own_text(formats[nested], types, topics)
    return text


def _measured(name: str, formats: Mapping[str, Format]) -> Layout:
    try:
        return measure(name, formats)
    except ValueError as error:
        raise LogError(str(error)) from None


def _nested(name: str, formats: Mapping[str, Format]) -> list[str]:
    """Return the format's nested formats, each once, in order of first mention."""
    found: list[str] = []
    queue = [name]
    for current in queue:
        for field in formats[current].fields:
            if field.type not in SIZES and not field.is_padding and field.type not in found:
                found.append(field.type)
                queue.append(field.type)
    return found


def _own_text(fmt: Format, types: Mapping[str, str], topics: Mapping[str, str]) -> str:
    lines = [f"# TOPICS {topics[fmt.name]}"]
    if not _has_timestamp(fmt):
        # The grammar would add it silently; written out, every reader of the text agrees.
        lines.append(f"uint64 {_TIMESTAMP}")
    shown = [field for field in fmt.fields if not field.is_padding]
    for field, name in zip(shown, field_names(shown)):
        lines.append(f"{_type_text(field, types)} {name}")
    return "\n".join(lines) + "\n"


def _has_timestamp(fmt: Format) -> bool:
    return any(field.name == _TIMESTAMP for field in fmt.fields)


def _type_text(field: Field, types: Mapping[str, str]) -> str:
    if field.type in PRIMITIVES:
        base = _RENAMED.get(field.type, field.type.removesuffix("_t"))
    else:
        base = types[field.type]
    return f"{base}[{field.count}]" if field.count else base


class Transcoder:
    """Turns the rows of one format into encoded messages of its definition.

    Attributes:
        topic: the topic's name, see ``topic_names``.
        type_name: CamelCase name of the message type.
        definition: self-contained definition text, see ``definition_text``.
        encoded_size: bytes of every encoded message, header included.
    """

    __slots__ = ("_encode", "_needed", "definition", "encoded_size", "topic", "type_name")

    def __init__(self, name: str, formats: Mapping[str, Format]) -> None:
        """Prepare for the format called ``name``.

        Raises:
            LogError: the format or a nested one is missing or cannot be laid out.
        """
        self.definition = definition_text(name, formats)
        self.topic = topic_names(formats)[name]
        self.type_name = type_names(formats)[name]
        self._needed = _measured(name, formats).needed
        pieces, body = _plan(name, formats)
        self.encoded_size = len(HEADER) + body
        self._encode = _compile(pieces, body)

    def encode(self, row: bytes) -> bytes:
        """Return the row as XCDR1 with its header; padding at the row's end may be missing.

        Raises:
            LogError: the row ends before its last field.
        """
        if len(row) < self._needed:
            raise LogError(f"a row of {self.type_name} has {len(row)} bytes, it needs {self._needed}")
        return self._encode(row)


def _plan(name: str, formats: Mapping[str, Format]) -> tuple[list[_Piece], int]:
    """Return the pieces that make up the encoded body, and its length in bytes.

    A primitive is aligned to its size, counted from the first byte after the header; an array as
    its elements, a nested message through its own fields only.
    """
    pieces: list[_Piece] = []
    out = end = pad = 0
    for at, size, count in _runs(name, formats, 0):
        gap = -out % size
        pad += gap
        out += gap + size * count
        if at < 0:
            pad += size * count
        elif pieces and not pad and at == end:
            pieces[-1].take += size * count
        else:
            pieces.append(_Piece(at, pad, size * count))
        if at >= 0:
            end, pad = at + size * count, 0
    return pieces, out


def _runs(name: str, formats: Mapping[str, Format], at: int) -> Iterator[tuple[int, int, int]]:
    """Yield (offset in the row, element size, count) of what is encoded; offset -1 stands for zeros."""
    if not _has_timestamp(formats[name]):
        yield -1, SIZES["uint64_t"], 1
    for field in formats[name].fields:
        count = field.count or 1
        size = SIZES.get(field.type) or measure(field.type, formats).size
        if field.type in SIZES and not field.is_padding:
            yield at, size, count
        elif not field.is_padding:
            for i in range(count):
                yield from _runs(field.type, formats, at + i * size)
        at += size * count


def _compile(pieces: list[_Piece], body: int) -> Callable[[bytes], bytes]:
    """Return the row-to-message function: one unpack of byte strings and one pack."""
    pack = struct.Struct("<4s" + "".join(f"{p.pad}x{p.take}s" for p in pieces)).pack
    if len(pieces) == 1 and pieces[0].at == 0:
        # Most formats are sorted by size and need no alignment: the pack alone cuts the row.
        return lambda row: pack(HEADER, row)
    skips, end = [], 0
    for piece in pieces:
        skips.append(f"{piece.at - end}x{piece.take}s")
        end = piece.at + piece.take
    unpack = struct.Struct("<" + "".join(skips)).unpack_from
    return lambda row: pack(HEADER, *unpack(row))
