"""This machine's real load as a companion computer reports it, from the texts under /proc."""

import os
from collections import deque
from typing import Any

SLICES = 10  # of 100 ms
CORES = 8
UNKNOWN_U8, UNKNOWN_I8, UNKNOWN_U32 = 255, 127, 0xFFFF_FFFF  # as MAVLink's ONBOARD_COMPUTER_STATUS has them
MIB = 1 << 20


class Ticks(tuple[int, int]):
    """Busy and all clock ticks of a processor since the start."""

    __slots__ = ()

    def load_since(self, before: "Ticks") -> int:
        """Return the load in percent."""
        spent = self[1] - before[1]
        return round(100 * (self[0] - before[0]) / spent) if spent > 0 else 0


def processor_ticks(stat: str) -> list[Ticks]:
    """Return the ticks in the text of /proc/stat: all cores together, then each."""
    ticks = []
    for line in stat.splitlines():
        if not line.startswith("cpu"):
            break
        fields = [int(field) for field in line.split()[1:9]]  # guest time is within user time already
        ticks.append(Ticks((sum(fields) - fields[3] - fields[4], sum(fields))))
    return ticks


def memory(meminfo: str) -> tuple[int, int]:
    """Return used and fitted MiB from the text of /proc/meminfo."""
    sizes = {}
    for line in meminfo.splitlines():
        name, _, rest = line.partition(":")
        sizes[name] = int(rest.split()[0])
    total = sizes["MemTotal"]
    return (total - sizes.get("MemAvailable", sizes.get("MemFree", 0))) // 1024, total // 1024


def _text(path: str) -> str:
    with open(path, encoding="ascii", errors="replace") as file:
        return file.read()


class Load:
    """Looks at the processors ten times a second, and tells once a second."""

    def __init__(self) -> None:
        self._ticks = processor_ticks(_text("/proc/stat"))
        self._told = self._ticks
        self._slices: deque[int] = deque([0] * SLICES, maxlen=SLICES)

    def look(self) -> None:
        """Note the load since the look before."""
        ticks = processor_ticks(_text("/proc/stat"))
        self._slices.append(ticks[0].load_since(self._ticks[0]))
        self._ticks = ticks

    def fields(self) -> dict[str, Any]:
        """Return the fields of `onboard_computer_status`; the cores' load since the call before."""
        cores = [now.load_since(before) for now, before in zip(self._ticks[1:], self._told[1:])][:CORES]
        self._told = self._ticks
        used, fitted = memory(_text("/proc/meminfo"))
        disk = os.statvfs("/")
        size = disk.f_frsize * disk.f_blocks // MIB
        unknown = [UNKNOWN_U32]
        return {
            "uptime": round(float(_text("/proc/uptime").split()[0]) * 1000) & UNKNOWN_U32,
            "cpu_cores": bytes(cores + [UNKNOWN_U8] * (CORES - len(cores))),
            "cpu_combined": bytes(self._slices),
            "gpu_cores": bytes([UNKNOWN_U8] * 4),
            "gpu_combined": bytes([UNKNOWN_U8] * SLICES),
            "temperature_board": UNKNOWN_I8,
            "temperature_core": (UNKNOWN_I8,) * CORES,
            "fan_speed": (-1,) * 4,
            "ram_usage": used,
            "ram_total": fitted,
            "storage_type": (*unknown, *unknown, *unknown, *unknown),
            "storage_usage": (size - disk.f_frsize * disk.f_bavail // MIB, *unknown * 3),
            "storage_total": (size, *unknown * 3),
            "link_type": unknown * 6,
            "link_tx_rate": unknown * 6,
            "link_rx_rate": unknown * 6,
            "link_tx_max": unknown * 6,
            "link_rx_max": unknown * 6,
        }
