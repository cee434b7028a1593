"""`uorb test`: uORB's own self test, on the shared bus of this machine, a process a part."""

import argparse
import os
import shutil
import subprocess
import sys
from time import monotonic

from ..broker.broker import Broker
from .options import Parser
from .values import dumps

LIMIT = 15.0  # seconds a part may take


def add(parser: Parser) -> None:
    """Add the verb's arguments."""
    parser.describe(
        "Test the bus of this machine: shared memory, waking, queues, instances; in processes and on a\n"
        "vehicle of its own, so a running bus is not disturbed. Status 1 if a part fails.",
        "uorb test",
        "uorb test latency",
    )
    parser.add_argument("parts", metavar="PART", nargs="*", help="parts to run; all of them if none is named")
    parser.add_argument("--json", action="store_true", help="one JSON object a line")


def run(args: argparse.Namespace) -> int:
    """Run the parts, a line each."""
    from ..selftest.parts import PARTS

    unknown = [part for part in args.parts if part not in PARTS]
    if unknown:
        from . import UsageError

        raise UsageError(f"no part {unknown[0]!r}: there are {', '.join(PARTS)}")
    failed = 0
    for part in args.parts or PARTS:
        began = monotonic()
        good, remark = _run(part)
        failed += not good
        _show(part, good, remark, monotonic() - began, as_json=args.json)
    if not args.json:
        print(f"{len(args.parts or PARTS) - failed} passed, {failed} failed")
    return int(failed > 0)


def _run(part: str) -> tuple[bool, str]:
    """Run one part on a vehicle of its own; whether it passed, and its remark."""
    vehicle = f"selftest-{os.getpid()}"
    command = [sys.executable, "-m", "uorb_net.selftest", vehicle, part]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=LIMIT, check=False)
    except subprocess.TimeoutExpired:
        return False, f"not finished after {LIMIT:.0f} s"
    finally:
        with Broker(vehicle) as broker:
            path = broker.path
        shutil.rmtree(path, ignore_errors=True)
    lines = (done.stdout if done.returncode in (0, 1) and done.stdout.strip() else done.stderr).splitlines()
    return done.returncode == 0, lines[-1] if lines else ""


def _show(part: str, good: bool, remark: str, seconds: float, *, as_json: bool) -> None:
    if as_json:
        print(dumps({"part": part, "passed": good, "seconds": round(seconds, 3), "remark": remark}), flush=True)
    else:
        print(f"{part:<16} {'ok' if good else 'FAILED':<6} {seconds:5.2f} s  {remark}".rstrip(), flush=True)
