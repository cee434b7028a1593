"""One line that says how two definitions differ on the wire, for events, errors and ``msg diff``."""

from collections.abc import Iterator
from itertools import islice

from uorb_net.messages.schema import Member, Schema

_SHOWN = 3


def difference(here: Schema, there: Schema) -> str | None:
    """Return the first differing fields, naming each with both types; None if there are none.

    Comments, constants, topics and queue lengths are no difference; nor is ``char`` against ``uint8``.
    """
    found = list(islice(_differences(here, there, ""), _SHOWN + 1))
    if not found:
        return None
    return "; ".join(found[:_SHOWN]) + ("; ..." if len(found) > _SHOWN else "")


def _differences(here: Schema, there: Schema, prefix: str) -> Iterator[str]:
    ours = {member.name: member for member in here.members}
    theirs = {member.name: member for member in there.members}
    names = [*ours, *(name for name in theirs if name not in ours)]
    for name in names:
        yield from _member(ours.get(name), theirs.get(name), prefix + name)
    common = [name for name in ours if name in theirs]
    yield from _order(common, [name for name in theirs if name in ours], prefix)


def _member(ours: Member | None, theirs: Member | None, path: str) -> Iterator[str]:
    if ours is None or theirs is None:
        yield f"field {path}: {_declared(ours)} here, {_declared(theirs)} there"
    elif _wire(ours) != _wire(theirs):
        yield f"field {path}: {ours.declared} here, {theirs.declared} there"
    elif ours.nested is not None and theirs.nested is not None:
        yield from _differences(ours.nested, theirs.nested, f"{path}.")


def _order(ours: list[str], theirs: list[str], prefix: str) -> Iterator[str]:
    for mine, other in zip(ours, theirs):
        if mine != other:
            yield f"field {prefix}{mine}: here where {prefix}{other} stands there (another order)"
            return


def _declared(member: Member | None) -> str:
    return "absent" if member is None else member.declared


def _wire(member: Member) -> tuple[str | int, int | None]:
    kind = member.type if member.primitive is None else member.primitive.type_id
    return kind, member.length
