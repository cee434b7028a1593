"""Messages as text and as JSON, and messages from JSON.

JSON has no NaN and no infinities: they are `null`, `"inf"` and `"-inf"`, both ways; `uint8[N]` is a list
of integers. In text a float is the shortest form that reads back as the same value of its field's type.
"""

import json
import math
import struct
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

import msgspec

from ..errors import EncodeError
from . import UsageError

if TYPE_CHECKING:
    from ..messages import Message
    from ..messages.schema import Member

_INDENT = "  "
_SINGLE = struct.Struct("<f")
_SMALLEST_NORMAL = 1.1754943508222875e-38  # of float32: below it six digits are more than it takes
_WORDS = {"inf": math.inf, "-inf": -math.inf, "nan": math.nan}
_LITERALS = {"NaN": "nan", "Infinity": "inf", "-Infinity": "-inf"}


# -- to text ---------------------------------------------------------------------------------------


def text_lines(message: "Message", indent: str = "") -> Iterator[str]:
    """Yield `field: value` lines in the order of the definition, nested fields below their name."""
    for member in message.__uorb__.schema.members:
        value = getattr(message, member.name)
        if member.nested is None:
            yield f"{indent}{member.name}: {_text(member, value)}"
            continue
        items = [("", value)] if member.length is None else [(f"[{i}]", v) for i, v in enumerate(value)]
        for index, item in items:
            yield f"{indent}{member.name}{index}:"
            yield from text_lines(item, indent + _INDENT)


def _text(member: "Member", value: Any) -> str:
    if member.is_text:
        return _quoted(value)
    if member.length is None:
        return _scalar_text(member.type, value)
    return f"[{', '.join(_scalar_text(member.type, item) for item in value)}]"


def _quoted(text: str) -> str:
    """Return text in double quotes; what could steer a terminal is escaped."""
    quoted = json.dumps(text, ensure_ascii=False)
    return "".join(c if c.isprintable() else f"\\u{ord(c):04x}" for c in quoted)


def _scalar_text(kind: str, value: Any) -> str:
    return float_text(value, single=kind == "float32") if isinstance(value, float) else str(value)


def float_text(value: float, *, single: bool) -> str:
    """Return the shortest decimal form that reads back as the same float32 (`single`) or float64."""
    return repr(_shortest(value) if single and math.isfinite(value) else value).removesuffix(".0")


def _shortest(value: float) -> float:
    # No two numbers of six digits are the same normal float32, so fewer digits need not be tried.
    for digits in range(6 if abs(value) >= _SMALLEST_NORMAL else 1, 10):
        candidate = float(f"{value:.{digits}g}")
        try:
            if _SINGLE.unpack(_SINGLE.pack(candidate))[0] == value:
                return candidate
        except OverflowError:
            pass  # rounded up beyond the largest float32
    return value


# -- to JSON ---------------------------------------------------------------------------------------


def dumps(value: object) -> str:
    """Return JSON in one line; floats that JSON lacks must have been replaced (`plain`)."""
    return msgspec.json.encode(value).decode()


def plain(value: Any) -> Any:
    """Return a message, or a value of one, in JSON's terms."""
    if isinstance(value, float):
        return value if math.isfinite(value) else None if math.isnan(value) else repr(value)
    if isinstance(value, (bytes, tuple)):
        return [plain(item) for item in value]
    if isinstance(value, msgspec.Struct):
        return {name: plain(getattr(value, name)) for name in value.__struct_fields__}
    return value


# -- from JSON -------------------------------------------------------------------------------------


def loads(text: str) -> dict[str, Any]:
    """Read a message's fields.

    Raises:
        UsageError: the text is no JSON, or no object.
    """
    try:
        value = json.loads(text, object_pairs_hook=_once_each, parse_constant=_LITERALS.__getitem__)
    except (ValueError, RecursionError) as error:
        raise UsageError(f"bad JSON: {error}; write '{{\"field\": value}}' in single quotes") from error
    if not isinstance(value, dict):
        raise UsageError(f"bad JSON: an object of fields is needed, such as '{{\"x\": 1}}', not {text[:40]!r}")
    return value


def _once_each(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    fields = dict(pairs)
    if len(fields) < len(pairs):
        names = [name for name, _ in pairs]
        raise ValueError(f"{next(n for n in names if names.count(n) > 1)!r} is given twice")
    return fields


def message_from(cls: "type[Message]", fields: dict[str, Any]) -> "Message":
    """Build a message of which every value fits.

    Raises:
        UsageError: an unknown field; similar names are suggested.
        EncodeError: a value does not fit its field.
    """
    message = _build(cls, fields, cls.__name__, "")
    message.__uorb__.encode(message, 0)
    return message


def _build(cls: "type[Message]", fields: dict[str, Any], outer: str, path: str) -> "Message":
    members = {member.name: member for member in cls.__uorb__.schema.members}
    values = {}
    for name, raw in fields.items():
        if name not in members:
            raise UsageError(_unknown(f"{outer}.{path}{name}", name, list(members)))
        values[name] = _value(members[name], cls.__uorb__.nested, raw, (outer, path + name))
    return cls(**values)


def _unknown(where: str, name: str, names: Sequence[str]) -> str:
    from difflib import get_close_matches

    near = get_close_matches(name, names)
    hint = f"did you mean {' or '.join(near)}?" if near else f"fields are {', '.join(names)}"
    return f"no field {where}: {hint}"


def _value(member: "Member", nested: "dict[str, type[Message]]", raw: Any, where: tuple[str, str]) -> Any:
    if member.length is None or member.is_text:
        return _single(member, nested, raw, where)
    if not isinstance(raw, list) or len(raw) != member.length:
        raise _misfit(member, raw, where)
    outer, path = where
    return tuple(_single(member, nested, item, (outer, f"{path}[{i}]")) for i, item in enumerate(raw))


def _single(member: "Member", nested: "dict[str, type[Message]]", raw: Any, where: tuple[str, str]) -> Any:
    """Return one value, or one element of an array."""
    if member.nested is not None:
        if not isinstance(raw, dict):
            raise EncodeError(*where, raw, f"an object of {member.nested.name}'s fields")
        return _build(nested[member.nested.name], raw, where[0], f"{where[1]}.")
    if member.is_text:
        fits = isinstance(raw, str)
    elif member.type == "bool":
        fits = isinstance(raw, int) and raw in (0, 1)
    elif member.primitive is not None and member.primitive.is_float:
        raw = math.nan if raw is None else _WORDS.get(raw, raw) if isinstance(raw, str) else _finite(raw)
        fits = isinstance(raw, (int, float)) and not isinstance(raw, bool)
    else:
        fits = isinstance(raw, int) and not isinstance(raw, bool)
    if not fits:
        raise _misfit(member, raw, where)
    return bool(raw) if member.type == "bool" else raw


def _finite(raw: Any) -> Any:
    """Return a number as it is; one beyond float64, which JSON reads as infinity, as its text."""
    return "a number beyond float64" if isinstance(raw, float) and math.isinf(raw) else raw


def _misfit(member: "Member", raw: Any, where: tuple[str, str]) -> EncodeError:
    from ..messages.fitting import allowed

    element = member.primitive is not None and where[1].endswith("]")
    words = member.primitive.allowed if element and member.primitive else allowed(member)
    return EncodeError(*where, raw, words)
