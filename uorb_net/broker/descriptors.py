"""What to do where file descriptors run out: a mapped node costs one, and the usual soft limit is 1,024."""

import errno
import resource  # here, since importing it takes a descriptor
from collections.abc import Callable
from typing import TypeVar

from ..errors import BusError

T = TypeVar("T")


def more_descriptors(action: Callable[[], T]) -> T:
    """Run `action`; where descriptors run out, raise the soft limit to the hard one and run it again.

    Raises:
        BusError: EMFILE, the hard limit is reached.
    """
    try:
        return action()
    except OSError as error:
        if error.errno != errno.EMFILE:
            raise
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if soft != hard:
        resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))
        try:
            return action()
        except OSError as error:
            if error.errno != errno.EMFILE:
                raise
    raise BusError(errno.EMFILE, f"this process has open all {hard} files it may have: raise the limit (ulimit -n)")
