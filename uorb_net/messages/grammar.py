"""Definition text to a frozen tree: one file, no other file, no disc, no classes.

Line based, as PX4 writes its ``msg/`` tree and ROS its px4_msgs: ``TYPE NAME``, ``TYPE NAME = VALUE``,
``#`` comments, ``# TOPICS a b`` at the start of a line. What is refused is refused with its line.
"""

from keyword import iskeyword
from sys import intern

import msgspec

from uorb_net.errors import DefinitionError
from uorb_net.messages.primitives import FLOAT32_MAX, PRIMITIVES, Primitive

PACKAGE = "px4_msgs"
TIMESTAMP = "timestamp"
QUEUE_LENGTH = "ORB_QUEUE_LENGTH"
TOPICS_MARK = "# TOPICS"

_VARIABLE = {"string", "wstring", "byte", "time", "duration"}


class Field(msgspec.Struct, frozen=True):
    """A field: ``type`` is a primitive or a CamelCase message name, ``length`` is None for no array.

    ``line`` counts from 1; 0 marks the implicit timestamp. ``written`` is the type as the text has it.
    """

    name: str
    type: str
    length: int | None = None
    line: int = 0
    written: str = ""


class Constant(msgspec.Struct, frozen=True):
    """A constant; it takes no space, in the encoding and in the hash."""

    name: str
    type: str
    value: int | float | bool
    line: int = 0


class Definition(msgspec.Struct, frozen=True):
    """One message definition.

    Attributes:
        name: CamelCase name.
        file: what error messages call the text.
        text: the text as it was read.
        fields: in order, the implicit timestamp included.
        constants: in order.
        topics: topic names, at least one.
        queue_length: ``ORB_QUEUE_LENGTH``, None where not given.
    """

    name: str
    file: str
    text: str
    fields: tuple[Field, ...]
    constants: tuple[Constant, ...]
    topics: tuple[str, ...]
    queue_length: int | None


def snake_case(name: str) -> str:
    """Return a message's topic name: ``_`` before each capital but the first (GpsRTCM: gps_r_t_c_m)."""
    return "".join(f"_{c.lower()}" if c.isupper() and i else c.lower() for i, c in enumerate(name))


def camel_case(name: str) -> str:
    """Return the message name of a file's or topic's name; a CamelCase name stays as it is."""
    return "".join(part[:1].upper() + part[1:] for part in name.split("_"))


def is_identifier(name: str) -> bool:
    """Tell whether a field, constant or topic may have this name: ASCII, and not ``__reserved``."""
    return name.isascii() and name.isidentifier() and not name.startswith("__")


def is_message_name(name: str) -> bool:
    """Tell whether a message may have this CamelCase name."""
    return is_identifier(name) and name[0].isupper() and not iskeyword(name)


def topics_in(text: str) -> list[str]:
    """Return the names on all ``# TOPICS`` lines, in order, once each, without parsing the rest."""
    if TOPICS_MARK not in text:
        return []
    names: dict[str, None] = {}
    for line in text.split("\n"):
        names.update(dict.fromkeys(_topics_of(line)))
    return list(names)


def parse(name: str, text: str, file: str | None = None, topic: str | None = None) -> Definition:
    """Parse one definition.

    Args:
        name: the message's CamelCase name.
        text: the definition; lines end in LF or CRLF.
        file: what errors call it; the name by default.
        topic: the topic where no ``# TOPICS`` line names any; the snake_case name by default.

    Raises:
        DefinitionError: the text breaks the grammar; file and line say where.
    """
    parser = _Parser(file or name)
    # Not splitlines(): that would also split comments at U+2028, form feeds and their like.
    for number, line in enumerate(text.split("\n"), 1):
        parser.line(number, line)
    return parser.finish(name, text, topic or snake_case(name))


class _Parser:
    """What has been read of one file so far."""

    def __init__(self, file: str) -> None:
        self.file = file
        self.fields: list[Field] = []
        self.constants: list[Constant] = []
        self.topics: dict[str, None] = {}
        self.seen: dict[str, int] = {}
        self.queue_length: int | None = None

    def line(self, number: int, line: str) -> None:
        """Take in one line."""
        self.number = number
        for topic in _topics_of(line):
            if not is_identifier(topic):
                self.refuse(f"{topic!r} is no topic name")
            self.topics[topic] = None
        body = line.partition("#")[0].strip()
        if body:
            declared, equals, value = body.partition("=")
            self.declaration(body, declared.split(), value.strip() if equals else None)

    def refuse(self, reason: str) -> None:
        """Raise for the present line."""
        raise DefinitionError(self.file, self.number, reason)

    def declaration(self, body: str, words: list[str], value: str | None) -> None:
        """Take in a field (``value`` None) or a constant."""
        if "[<=" in body:
            self.refuse(f"{body!r}: only arrays of fixed length, T[N], are known")
        if len(words) != 2:
            self.refuse(f"{body!r} is neither a field 'TYPE NAME' nor a constant 'TYPE NAME = VALUE'")
        kind, length = self.type(words[0])
        self.name(words[1], words[0])
        if value is None:
            # Interned, as keywords in compiled calls are: msgspec then matches them by identity.
            self.fields.append(Field(intern(words[1]), kind, length, self.number, words[0]))
        elif length is not None or kind not in PRIMITIVES:
            self.refuse(f"a constant cannot be of type {words[0]}")
        else:
            self.constant(words[1], PRIMITIVES[kind], value)

    def type(self, token: str) -> tuple[str, int | None]:
        """Return base type and array length of a type token."""
        base, bracket, rest = token.partition("[")
        if base in _VARIABLE:
            self.refuse(f"unknown type {base}: every field has a fixed size (text is char[N])")
        length = self.length(token, rest) if bracket else None
        return (base, length) if base in PRIMITIVES else (self.nested(base), length)

    def length(self, token: str, rest: str) -> int:
        """Return the N of ``T[N]``."""
        digits = rest.removesuffix("]")
        # Twelve digits: far past any real size, far below what int() takes long for.
        if digits == rest or not (digits.isascii() and digits.isdigit()) or len(digits) > 12:
            self.refuse(f"array {token!r}: only one dimension of fixed length, T[N], is known")
        if int(digits) < 1:
            self.refuse(f"array {token!r}: the length must be at least 1")
        return int(digits)

    def nested(self, base: str) -> str:
        """Return the CamelCase name of a nested message, also given as px4_msgs/Name or px4_msgs/msg/Name."""
        last = base.removeprefix(f"{PACKAGE}/").removeprefix("msg/")
        if not is_identifier(last) or not is_message_name(camel_case(last)):
            self.refuse(f"unknown type {base!r}")
        return camel_case(last)

    def name(self, name: str, declared: str) -> None:
        """Check the name of a field or constant."""
        if not is_identifier(name):
            hint = f" (an array's length belongs to its type: {declared}[N])" if "[" in name else ""
            self.refuse(f"{name!r} is no identifier{hint}")
        if name in self.seen:
            self.refuse(f"duplicate {name!r}, first on line {self.seen[name]}")
        self.seen[name] = self.number

    def constant(self, name: str, kind: Primitive, text: str) -> None:
        """Take in a constant's value."""
        value = _number(kind, text)
        if value is None:
            self.refuse(f"constant {name} = {text or 'nothing'}: not {kind.allowed}")
            return
        if name == QUEUE_LENGTH:
            if kind.is_float or not 1 <= value <= 255:
                self.refuse(f"{QUEUE_LENGTH} = {text} is outside 1..255")
            self.queue_length = int(value)
        self.constants.append(Constant(name, kind.name, value, self.number))

    def finish(self, name: str, text: str, topic: str) -> Definition:
        """Return the definition, with the implicit timestamp and the default topic."""
        self.number = self.seen.get(TIMESTAMP, 0)
        if not any(field.name == TIMESTAMP for field in self.fields):
            if self.number:
                self.refuse("the implicit field timestamp has a constant's name")
            self.fields.insert(0, Field(TIMESTAMP, "uint64"))
        topics = tuple(self.topics) or (topic,)
        fields, constants = tuple(self.fields), tuple(self.constants)
        return Definition(name, self.file, text, fields, constants, topics, self.queue_length)


def _topics_of(line: str) -> list[str]:
    """Return the topics of a ``# TOPICS`` line, nothing for any other line."""
    mark = len(TOPICS_MARK)
    if line.startswith(TOPICS_MARK) and line[mark : mark + 1].isspace():
        return line[mark:].split()
    return []


def _number(kind: Primitive, text: str) -> int | float | bool | None:
    """Return a constant's value, None if it is not one of its type."""
    if kind.name == "bool":
        return {"true": True, "True": True, "1": True, "false": False, "False": False, "0": False}.get(text)
    return _float(kind, text) if kind.is_float else _integer(kind, text)


def _integer(kind: Primitive, text: str) -> int | None:
    digits = text[1:] if text[:1] in ("-", "+") else text
    if not (digits.isascii() and digits.isdigit()) or len(digits) > 40:
        return None
    value = int(text)
    return value if kind.low <= value <= kind.high else None


def _float(kind: Primitive, text: str) -> float | None:
    # float() alone would take nan, inf and 1_0 too.
    if not set(text) <= set("0123456789.eE+-"):
        return None
    try:
        value = float(text)
    except ValueError:
        return None
    limit = FLOAT32_MAX if kind.name == "float32" else 1.7976931348623157e308
    return value if abs(value) <= limit else None
