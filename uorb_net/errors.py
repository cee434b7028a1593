"""All errors of uorb_net, sorted by what a caller can do about them.

UorbError                      every one of them; ``errno`` is the code uORB's C functions would set
    UnknownTopicError  ENOENT  no definition of that name: check the spelling, ``messages.add_path``
    NoDataError        EIO     nothing published, or nobody advertises: try again later
    InstanceError      EIO     no free instance, or one out of range
    TopicMismatchError EINVAL  another definition, type or topic than the node or handle has
    ClosedError        EBADF   used after close, unadvertise, or in a forked child
    QueueLengthError   EINVAL  queue_length outside 1..255 (also ValueError)
    DefinitionError    EINVAL  a bad .msg text: file and line say where (also ValueError)
    EncodeError        EINVAL  a value does not fit its field (also ValueError)
    DecodeError        EINVAL  bytes that cannot be the type's (also ValueError)
    BusyError          EAGAIN  a stopped process holds the writers' exclusion
    BusError           (OS)    the runtime directory is full or unusable
    LinkError          EIO     the network side cannot start
    SpinnerError       EBUSY   a conflicting spinner on the queue
    ServiceError       EIO     a service call failed
"""

import errno as _errno


class UorbError(Exception):
    """Base of every error of this package; ``errno`` holds uORB's code."""

    errno: int = _errno.EINVAL


class UnknownTopicError(UorbError):
    """No definition of this name on the search path, nor on the bus."""

    errno = _errno.ENOENT


class NoDataError(UorbError):
    """Nothing was published in the present advertisement, or nobody advertises."""

    errno = _errno.EIO


class InstanceError(UorbError):
    """No free instance, or an instance number out of range."""

    errno = _errno.EIO


class TopicMismatchError(UorbError):
    """A definition, type or topic other than the one in force."""


class ClosedError(UorbError):
    """The object was closed, spent, or belongs to the parent of a fork."""

    errno = _errno.EBADF


class QueueLengthError(UorbError, ValueError):
    """A queue length outside 1..255."""


class DefinitionError(UorbError, ValueError):
    """A message definition that cannot be used.

    Attributes:
        file: the file, or the message's name where the text came from elsewhere.
        line: the line number from 1; 0 where the whole file is meant.
        reason: what is wrong, without the place.
    """

    def __init__(self, file: str, line: int, reason: str) -> None:
        super().__init__(f"{file}:{line}: {reason}" if line else f"{file}: {reason}")
        self.file = file
        self.line = line
        self.reason = reason


class EncodeError(UorbError, ValueError):
    """A value that does not fit its field.

    Attributes:
        message: the message's name.
        field: the field's path, such as ``q[2]`` or ``previous.lat``.
        value: the value given.
        allowed: the allowed range, in words.
    """

    def __init__(self, message: str, field: str, value: object, allowed: str) -> None:
        shown = repr(value)
        if len(shown) > 80:
            shown = shown[:77] + "..."
        super().__init__(f"{message}.{field} = {shown} does not fit: allowed is {allowed}")
        self.message = message
        self.field = field
        self.value = value
        self.allowed = allowed


class DecodeError(UorbError, ValueError):
    """Bytes that cannot be an encoded message of the type."""


class BusyError(UorbError):
    """Another process stopped in the middle of a publication; nothing was published."""

    errno = _errno.EAGAIN


class BusError(UorbError):
    """The shared bus's directory is full or unusable; ``errno`` is the system's."""

    def __init__(self, code: int, text: str) -> None:
        super().__init__(text)
        self.errno = code


class LinkError(UorbError):
    """The link cannot start: endpoint in use, bad endpoint, or another link holds the bus."""

    errno = _errno.EIO


class SpinnerError(UorbError):
    """A conflicting spinner is already on the queue."""

    errno = _errno.EBUSY


class ServiceError(UorbError):
    """A service call failed at the server, or the server went away."""

    errno = _errno.EIO
