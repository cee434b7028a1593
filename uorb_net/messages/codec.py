"""Source text of a type's ``encode``, ``decode`` and ``__post_init__``, generated once per type.

Straight-line code around one ``struct.Struct`` each way. ``encode`` checks only what ``struct`` would
let pass in silence; on any doubt it calls ``diagnose``, which names the culprit.
"""

from keyword import iskeyword

from uorb_net.messages.layout import HEADER_VALUE, Layout, values
from uorb_net.messages.schema import Member, Schema

# Up to here an array is cheaper unpacked into locals than starred (encode) or sliced (decode); measured.
_SMALL_ARRAY = 8
_SMALL_MESSAGE = 40


def source(schema: Schema, formats: Layout) -> str:
    """Return the source of ``encode(m, stamp_us)`` and ``decode(buffer, offset)``.

    It runs with these names: ``struct``, ``diagnose``, ``refusals``, the class and the nested classes.
    """
    head = [
        f"pack = struct.Struct({formats.encoding!r}).pack",
        f"unpack = struct.Struct({formats.decoding!r}).unpack_from",
    ]
    return "\n".join([*head, "", *_Encode(schema).source(), "", *_decode(schema)]) + "\n"


def post_init_source(schema: Schema) -> str:
    """Return the source of ``__post_init__(self)``, empty where no field needs coercing.

    It runs with the name ``coerce``, and calls it only where an array is not what is stored.
    """
    tests = [test for member in schema.members if (test := _misfit(member))]
    if not tests:
        return ""
    lines = ["def __post_init__(self):", "    if (", "        " + "\n        or ".join(tests)]
    return "\n".join([*lines, "    ):", "        coerce(self)"]) + "\n"


def _misfit(member: Member) -> str:
    if member.length is None or member.is_text:
        return ""
    field, stored = _attribute("self", member), "bytes" if member.is_bytes else "tuple"
    return f"type({field}) is not {stored} or len({field}) != {member.length}"


def _attribute(variable: str, member: Member) -> str:
    if iskeyword(member.name):
        return f"getattr({variable}, {member.name!r})"
    return f"{variable}.{member.name}"


def _listed(names: list[str]) -> str:
    """Return names as a tuple is written, or taken apart."""
    return ", ".join(names) + ("," if len(names) == 1 else "")


class _Encode:
    """Writes ``encode``: statements collected in ``lines``, the values to pack returned level by level."""

    def __init__(self, schema: Schema) -> None:
        self.schema = schema
        self.lines: list[str] = []
        self.indent = 2
        self.count = 0

    def source(self) -> list[str]:
        """Return the lines of the function."""
        packed = self.message(self.schema, "m")
        body = [f"            {value}," for value in (str(HEADER_VALUE), *packed)]
        head = ["def encode(m, stamp_us):", "    try:", *self.lines]
        return [*head, "        return pack(", *body, "        )", *_REFUSED]

    def message(self, schema: Schema, variable: str) -> list[str]:
        """Write what one message needs; return its values."""
        packed: list[str] = []
        bools: list[str] = []
        for member in schema.members:
            packed += self.member(member, variable, bools)
        if bools:
            # One test for all of them: only 0 and 1 leave nothing when shifted; others raise or remain.
            self.write(f"if ({' | '.join(bools)}) >> 1: raise ValueError")
        return packed

    def member(self, member: Member, variable: str, bools: list[str]) -> list[str]:
        """Write what one member needs; return its values."""
        field = _attribute(variable, member)
        if member.nested is not None:
            return self.nested(member, member.nested, field)
        if member.length is not None:
            return self.array(member, field)
        if member.type == "bool":
            bools.append(self.local("b", field))
            return bools[-1:]
        if variable == "m" and member.name == "timestamp" and self.schema.stamped:
            self.write(f"stamp = {field}")
            # Not `or`: None, "" and 0.0 are false too, and have to be refused.
            self.write("if not stamp: stamp |= stamp_us")
            return ["stamp"]
        return [field]

    def array(self, member: Member, field: str) -> list[str]:
        """Write what an array of primitives needs."""
        assert member.length is not None
        if member.is_text:
            return [self.checked("s", f'{field}.encode("ascii")', f"len({{}}) > {member.length}")]
        if member.is_bytes:
            return [self.checked("s", field, f"len({{}}) != {member.length}")]
        if member.type == "bool":
            wrong = f"len({{}}) != {member.length} or max({{}}) > 1"
            return [self.checked("b", f"bytes({field})", wrong)]
        if member.length > _SMALL_ARRAY:
            return ["*" + self.checked("a", field, f"len({{}}) != {member.length}")]
        name = self.name("a")
        elements = [f"{name}_{i}" for i in range(member.length)]
        self.write(f"{_listed(elements)} = {field}")
        return elements

    def nested(self, member: Member, schema: Schema, field: str) -> list[str]:
        """Write what a nested message or an array of them needs."""
        if member.length is None:
            name = self.checked("n", field, f"type({{}}) is not {schema.name}")
            return self.message(schema, name)
        every = self.checked("n", field, f"len({{}}) != {member.length}")
        flat, each = self.local("f", "[]"), self.name("e")
        self.write(f"for {each} in {every}:")
        self.indent += 1
        self.write(f"if type({each}) is not {schema.name}: raise TypeError")
        packed = self.message(schema, each)
        self.write(f"{flat} += {', '.join(packed)},")
        self.indent -= 1
        return ["*" + flat]

    def checked(self, letter: str, expression: str, wrong: str) -> str:
        """Write an assignment to a new local and its check; return the local."""
        name = self.local(letter, expression)
        self.write(f"if {wrong.format(name, name)}: raise ValueError")
        return name

    def local(self, letter: str, expression: str) -> str:
        """Write an assignment to a new local; return the local."""
        name = self.name(letter)
        self.write(f"{name} = {expression}")
        return name

    def name(self, letter: str) -> str:
        """Return a new local name."""
        self.count += 1
        return f"{letter}{self.count}"

    def write(self, line: str) -> None:
        """Write one statement."""
        self.lines.append("    " * self.indent + line)


_REFUSED = ["    except refusals:", "        return diagnose(m, stamp_us)"]


def _decode(schema: Schema) -> list[str]:
    """Return the lines of ``decode``."""
    total = sum(map(values, schema.members))
    writer = _Decode(small=total <= _SMALL_MESSAGE and _plain(schema))
    result = writer.message(schema, 0, "", "    ")
    names = _listed([f"t{i}" for i in range(total)]) if writer.small else "t"
    return ["def decode(buffer, offset):", f"    {names} = unpack(buffer, offset)", f"    return {result}"]


def _plain(schema: Schema) -> bool:
    """Tell whether every value can be a local: no long arrays, no arrays of messages."""
    for member in schema.members:
        if member.nested is not None:
            if member.length is not None or not _plain(member.nested):
                return False
        elif values(member) > _SMALL_ARRAY:
            return False
    return True


class _Decode:
    """Writes the expression that builds a message from the unpacked values.

    ``at`` is a value's index, counted from ``base``: empty, or the loop variable of an array of messages.
    """

    def __init__(self, small: bool) -> None:
        self.small = small
        self.depth = 0

    def message(self, schema: Schema, at: int, base: str, indent: str) -> str:
        """Return the call that builds one message."""
        inner = indent + "    "
        lines = [f"{schema.name}("]
        for member in schema.members:
            lines.append(f"{inner}{self.member(member, at, base, inner)},  # {member.name}")
            at += values(member)
        return "\n".join([*lines, f"{indent})"])

    def member(self, member: Member, at: int, base: str, indent: str) -> str:
        """Return the expression of one member."""
        if member.nested is not None:
            if member.length is None:
                return self.message(member.nested, at, base, indent)
            return self.messages(member, member.nested, at, base, indent)
        if member.is_text:
            return f'{self.value(at, base)}.partition(b"\\0")[0].decode("latin-1")'
        if member.is_tuple:
            return self.array(values(member), at, base)
        return self.value(at, base)

    def array(self, count: int, at: int, base: str) -> str:
        """Return the expression of a tuple."""
        if self.small:
            return f"({_listed([f't{i}' for i in range(at, at + count)])})"
        return f"t[{base}{at}:{base}{at + count}]"

    def messages(self, member: Member, schema: Schema, at: int, base: str, indent: str) -> str:
        """Return the expression of an array of messages."""
        index = f"i{self.depth}"
        self.depth += 1
        each = self.message(schema, 0, f"{index} + ", indent)
        self.depth -= 1
        bounds = f"{base}{at}, {base}{at + values(member)}, {sum(map(values, schema.members))}"
        return f"tuple([{each} for {index} in range({bounds})])"

    def value(self, at: int, base: str) -> str:
        """Return the expression of one unpacked value."""
        return f"t{at}" if self.small else f"t[{base}{at}]"
