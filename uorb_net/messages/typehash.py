"""RIHS01 type hashes, as ROS 2 computes them for ``px4_msgs/msg/NAME``.

SHA-256 of a type description in JSON (REP 2016; byte-exact form in rcl's ``type_hash.c``). Constants,
comments and topics do not count; a ``char`` counts as ``uint8``; the implicit timestamp does count.
"""

from uorb_net.messages.grammar import PACKAGE
from uorb_net.messages.schema import Member, Schema

PREFIX = "RIHS01_"

_NESTED = 1
_ARRAY = 48


def type_hash(schema: Schema) -> str:
    """Return ``RIHS01_`` and 64 hex digits."""
    from hashlib import sha256

    return PREFIX + sha256(description(schema).encode()).hexdigest()


def description(schema: Schema) -> str:
    """Return the JSON text whose SHA-256 is the hash."""
    # Names are ASCII identifiers, so nothing in here needs JSON's escapes.
    nested = schema.nested()
    referenced = ", ".join(_type(nested[name]) for name in sorted(nested))
    return f'{{"type_description": {_type(schema)}, "referenced_type_descriptions": [{referenced}]}}'


def ros_name(schema: Schema) -> str:
    """Return the name ROS 2 knows the type by."""
    return f"{PACKAGE}/msg/{schema.name}"


def _type(schema: Schema) -> str:
    fields = ", ".join(_field(member) for member in schema.members)
    return f'{{"type_name": "{ros_name(schema)}", "fields": [{fields}]}}'


def _field(member: Member) -> str:
    kind = _NESTED if member.primitive is None else member.primitive.type_id
    nested = "" if member.nested is None else ros_name(member.nested)
    if member.length is not None:
        kind += _ARRAY
    return (
        f'{{"name": "{member.name}", "type": {{"type_id": {kind}, "capacity": {member.length or 0}, '
        f'"string_capacity": 0, "nested_type_name": "{nested}"}}}}'
    )
