"""Definitions joined with those they nest: what a type hash, a codec and a comparison work on."""

from collections.abc import Callable

import msgspec

from uorb_net.errors import DefinitionError
from uorb_net.messages.grammar import PACKAGE, Definition, Field
from uorb_net.messages.primitives import PRIMITIVES, Primitive

# Definitions also come from other hosts: bounds on what a text may cost here.
MAX_BYTES = 64 * 2**20
MAX_ITEMS = 2**17
MAX_DEPTH = 32

_RULE = "=" * 80
_MARK = f"MSG: {PACKAGE}/"


class Member(msgspec.Struct, frozen=True):
    """A field with what its type means; exactly one of ``primitive`` and ``nested`` is set."""

    name: str
    type: str
    length: int | None = None
    primitive: Primitive | None = None
    nested: "Schema | None" = None

    @property
    def declared(self) -> str:
        """The type as a definition writes it, such as ``float32[4]``."""
        return self.type if self.length is None else f"{self.type}[{self.length}]"

    @property
    def is_bytes(self) -> bool:
        """True for ``uint8[N]``, in Python ``bytes``."""
        return self.type == "uint8" and self.length is not None

    @property
    def is_text(self) -> bool:
        """True for ``char[N]``, in Python ``str``."""
        return self.type == "char" and self.length is not None

    @property
    def is_tuple(self) -> bool:
        """True for every other array."""
        return self.length is not None and not self.is_bytes and not self.is_text


class Schema(msgspec.Struct, frozen=True):
    """A message definition whose nested messages are resolved."""

    definition: Definition
    members: tuple[Member, ...]

    @property
    def name(self) -> str:
        """The CamelCase name."""
        return self.definition.name

    @property
    def stamped(self) -> bool:
        """True if ``timestamp`` is a plain uint64, which a publisher's 0 leaves to be filled in."""
        return any(m.name == "timestamp" and m.declared == "uint64" for m in self.members)

    def nested(self) -> dict[str, "Schema"]:
        """Return all nested schemas by name, through all levels, in the order of first use."""
        found: dict[str, Schema] = {}
        _collect(self, found)
        return found

    def full_text(self) -> str:
        """Return the self-contained text, as MCAP's ``ros2msg`` wants it.

        The own text, then for each nested type a line of 80 ``=``, a line ``MSG: px4_msgs/Name``, its text.
        """
        parts = [_ended(self.definition.text)]
        for name, schema in self.nested().items():
            parts.append(f"{_RULE}\n{_MARK}{name}\n{_ended(schema.definition.text)}")
        return "".join(parts)


def split_full_text(name: str, text: str) -> dict[str, str]:
    """Return the single texts of a self-contained one by message name; the first is ``name``'s."""
    lines = _ended(text).split("\n")[:-1]
    texts: dict[str, list[str]] = {name: []}
    current, after_rule = texts[name], False
    for line in lines:
        bare = line.rstrip("\r ")
        if after_rule and bare.startswith("MSG: "):
            current = texts.setdefault(bare.removeprefix("MSG: ").rpartition("/")[2], [])
        elif bare != _RULE:
            current.append(line)
        after_rule = bare == _RULE
    return {key: "".join(f"{line}\n" for line in own) for key, own in texts.items()}


def resolve(definition: Definition, lookup: Callable[[str], "Schema | Definition | None"]) -> Schema:
    """Join a definition with those it nests.

    Args:
        definition: the outermost one.
        lookup: returns the schema or definition of a name, None if there is none.

    Raises:
        DefinitionError: a nested message is unknown, recursive or bad, or the whole is too large.
    """
    return _Resolver(lookup).schema(definition, (definition.name,))


class _Resolver:
    """One resolution: each nested message is looked up and measured once."""

    def __init__(self, lookup: Callable[[str], Schema | Definition | None]) -> None:
        self.lookup = lookup
        self.done: dict[str, Schema] = {}
        self.sizes: dict[str, tuple[int, int]] = {}

    def schema(self, definition: Definition, path: tuple[str, ...]) -> Schema:
        """Resolve one definition; ``path`` names those it is nested in, itself last."""
        members = tuple(self.member(definition, field, path) for field in definition.fields)
        schema = Schema(definition, members)
        self.measure(schema)
        self.done[schema.name] = schema
        return schema

    def member(self, definition: Definition, field: Field, path: tuple[str, ...]) -> Member:
        """Resolve one field."""
        if field.type in PRIMITIVES:
            return Member(field.name, field.type, field.length, PRIMITIVES[field.type])
        if field.type in path:
            chain = " -> ".join((*path, field.type))
            raise DefinitionError(definition.file, field.line, f"recursive message {chain}")
        if len(path) >= MAX_DEPTH:
            raise DefinitionError(definition.file, field.line, f"nested more than {MAX_DEPTH} deep")
        return Member(field.name, field.type, field.length, nested=self.nested(definition, field, path))

    def nested(self, definition: Definition, field: Field, path: tuple[str, ...]) -> Schema:
        """Return the schema of a field's message."""
        found = self.done.get(field.type) or self.lookup(field.type)
        if found is None:
            raise DefinitionError(definition.file, field.line, f"unknown type {field.written!r}")
        return found if isinstance(found, Schema) else self.schema(found, (*path, field.type))

    def measure(self, schema: Schema) -> tuple[int, int]:
        """Return bytes and items, padding left out; refuse what is too large before it is laid out."""
        if schema.name in self.sizes:
            return self.sizes[schema.name]
        size = items = 0
        for field, member in zip(schema.definition.fields, schema.members):
            own_size, own_items = self.unit(member)
            size += own_size * (member.length or 1)
            items += own_items * (member.length or 1) if member.nested else 1
            if size > MAX_BYTES or items > MAX_ITEMS:
                reason = f"larger than {MAX_BYTES} bytes or {MAX_ITEMS} nested items"
                raise DefinitionError(schema.definition.file, field.line, reason)
        self.sizes[schema.name] = (size, items)
        return size, items

    def unit(self, member: Member) -> tuple[int, int]:
        """Return bytes and items of one element of a member."""
        if member.primitive is not None:
            return member.primitive.size, 1
        assert member.nested is not None
        return self.measure(member.nested)


def _collect(schema: Schema, found: dict[str, Schema]) -> None:
    for member in schema.members:
        if member.nested is not None and member.nested.name not in found:
            found[member.nested.name] = member.nested
            _collect(member.nested, found)


def _ended(text: str) -> str:
    return text if text.endswith("\n") else text + "\n"
