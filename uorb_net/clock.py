"""The host's time base: CLOCK_MONOTONIC in integer microseconds, one for all processes of a host."""

from time import monotonic_ns


def hrt_absolute_time() -> int:
    """Return the time since the host's start in microseconds (uORB's hrt_absolute_time)."""
    return monotonic_ns() // 1000
