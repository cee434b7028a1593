"""Message classes by name: ``from uorb_net.msg import SensorCombined``.

Any message on the search path can be imported; it is loaded when it is first named.
"""

from typing import Any

from uorb_net import messages as _messages
from uorb_net.errors import DefinitionError as _DefinitionError
from uorb_net.errors import UnknownTopicError as _UnknownTopicError


# Any, not type[Message]: only so does a type checker take the name as a type and know of no missing field.
def __getattr__(name: str) -> Any:
    if name == "__all__":
        return [known for known in _messages.names() if _loads(known)]
    if not name[:1].isupper():
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    try:
        return _messages.load(name)
    except _UnknownTopicError as error:
        raise AttributeError(f"module {__name__!r}: {error}") from None


def __dir__() -> list[str]:
    return _messages.names()


def _loads(name: str) -> bool:
    """Tell whether a star import can have the name: a bad definition hurts only itself."""
    try:
        _messages.load(name)
    except _DefinitionError:
        return False
    return True
