"""A node's tables of publishers, subscribers and sleepers: pure code over its words.

Every function is called under the directory lock unless it says otherwise. Who lives is handed in.
"""

from collections.abc import Callable, Iterator
from errno import ENOSPC
from typing import NamedTuple

from ..errors import BusError
from .layout import (
    GENERATION,
    PUBLISHERS,
    PUBLISHERS_MAX,
    SLEEPERS,
    SLEEPERS_MAX,
    SUBSCRIBERS,
    SUBSCRIBERS_MAX,
    UNADVERTISED,
    W_FLOOR,
    W_G,
    W_LOST,
    W_PRIORITY,
    W_SLEEPERS,
)

NO_INTERVAL = (1 << 64) - 1


class Share(NamedTuple):
    """One process's publications on a node, for one origin."""

    at: int  # word index of the entry
    process: int
    publications: int
    priority: int
    origin: int
    own: bool  # made with advertise_multi

    def pack(self) -> int:
        """Return the entry's second word."""
        return self.publications | self.priority << 16 | self.origin << 24 | self.own << 40


def shares(words: "memoryview[int]") -> Iterator[Share]:
    """Yield the publisher entries in use, the living and the dead."""
    for index in range(PUBLISHERS, PUBLISHERS + 2 * PUBLISHERS_MAX, 2):
        process = words[index]
        if process:
            word = words[index + 1]
            yield Share(index, process, word & 0xFFFF, word >> 16 & 0xFF, word >> 24 & 0xFFFF, bool(word >> 40 & 1))


def add_share(words: "memoryview[int]", name: str, share: Share) -> None:
    """Count `share` in: one more publication of its process and origin."""
    for present in shares(words):
        if (present.process, present.origin) == (share.process, share.origin):
            words[present.at + 1] = share._replace(publications=present.publications + 1).pack()
            return
    for index in range(PUBLISHERS, PUBLISHERS + 2 * PUBLISHERS_MAX, 2):
        if not words[index]:
            words[index + 1] = share.pack()
            words[index] = share.process
            return
    raise BusError(ENOSPC, f"{name}: {PUBLISHERS_MAX} processes publish already, which is the most a node takes")


def drop_share(words: "memoryview[int]", process: int, origin: int) -> None:
    """Count one publication of `process` and `origin` out; none left frees the entry."""
    for share in shares(words):
        if (share.process, share.origin) == (process, origin):
            if share.publications > 1:
                words[share.at + 1] = share._replace(publications=share.publications - 1).pack()
            else:
                words[share.at] = 0
            return


def purge(words: "memoryview[int]", alive: Callable[[int], bool]) -> bool:
    """Remove the entries of dead processes; unadvertise where nobody is left. True if any were dead."""
    found = False
    living = 0
    for share in shares(words):
        if alive(share.process):
            living += 1
        else:
            words[share.at] = 0
            found = True
    for index in subscriber_entries(words):
        if not alive(words[index]):
            words[W_LOST] += words[index + 3]
            words[index] = 0
            found = True
    if not living and not words[W_G] & UNADVERTISED:
        words[W_G] |= UNADVERTISED
        found = True
    return found


def begin_advertisement(words: "memoryview[int]", priority: int) -> None:
    """Start anew on a node that nobody advertises: what lies in the ring is not readable any more."""
    words[W_FLOOR] = words[W_G] & GENERATION
    words[W_PRIORITY] = priority
    words[W_G] &= ~UNADVERTISED


# -- subscribers ----------------------------------------------------------------------------------


def subscriber_entries(words: "memoryview[int]") -> Iterator[int]:
    """Yield the word indices of the subscriber entries in use."""
    for index in range(SUBSCRIBERS, SUBSCRIBERS + 4 * SUBSCRIBERS_MAX, 4):
        if words[index]:
            yield index


def claim_subscriber(words: "memoryview[int]", name: str, process: int) -> int:
    """Return the index of `process`'s entry, a fresh one if it has none."""
    free = 0
    for index in range(SUBSCRIBERS, SUBSCRIBERS + 4 * SUBSCRIBERS_MAX, 4):
        if words[index] == process:
            return index
        if not words[index] and not free:
            free = index
    if not free:
        raise BusError(ENOSPC, f"{name}: {SUBSCRIBERS_MAX} processes subscribe already, which is the most a node takes")
    words[free + 1] = 0
    words[free + 2] = NO_INTERVAL
    words[free + 3] = 0
    words[free] = process
    return free


def release_subscriber(words: "memoryview[int]", index: int) -> None:
    """Free an entry whose process subscribes no more; its losses go to the node's sum."""
    words[W_LOST] += words[index + 3]
    words[index] = 0


def total_lost(words: "memoryview[int]") -> int:
    """Return what all subscriptions lost, past ones included. No lock needed."""
    return words[W_LOST] + sum(words[index + 3] for index in subscriber_entries(words))


# -- sleepers -------------------------------------------------------------------------------------


def claim_sleeper(words: "memoryview[int]", number: int, dead: Callable[[int], bool]) -> int | None:
    """Return the index of sleeper `number`'s entry; None if the table is full of the living."""
    free = 0
    for index in range(SLEEPERS, SLEEPERS + 2 * SLEEPERS_MAX, 2):
        if words[index] == number:
            return index
        if not words[index] and not free:
            free = index
    if not free:
        free = next((i for i in sleeper_entries(words) if dead(words[i])), 0)
        if not free:
            return None
    words[free + 1] = 0
    words[free] = number
    words[W_SLEEPERS] = max(words[W_SLEEPERS], (free - SLEEPERS) // 2 + 1)
    return free


def sleeper_entries(words: "memoryview[int]") -> range:
    """Return the word indices of the sleeper entries ever used. No lock needed."""
    return range(SLEEPERS, SLEEPERS + 2 * words[W_SLEEPERS], 2)


def release_sleeper(words: "memoryview[int]", number: int) -> None:
    """Free sleeper `number`'s entry, and let publishers scan no further than they must."""
    last = 0
    for index in sleeper_entries(words):
        if words[index] == number:
            words[index + 1] = 0
            words[index] = 0
        elif words[index]:
            last = (index - SLEEPERS) // 2 + 1
    words[W_SLEEPERS] = last
