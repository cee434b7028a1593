"""`uorb test`: uORB's own self test as a user runs it."""

import json
import os
from typing import Any

PARTS = ["single", "multi", "multi reversed", "unadvertise", "queue", "queue with poll", "interval", "latency"]


def test_every_part_passes_and_leaves_nothing_behind(shell: Any) -> None:
    """A line a part, status 0, within 20 s, and no bus of its own stays."""
    done = shell.run("test", "--json")
    assert done.returncode == 0, done.stdout
    rows = [json.loads(line) for line in done.stdout.splitlines()]
    assert [row["part"] for row in rows] == PARTS
    assert all(row["passed"] for row in rows)
    assert sum(row["seconds"] for row in rows) < 20
    assert not [name for name in os.listdir(shell.folder) if name.startswith("selftest-")]


def test_a_part_that_is_none_is_wrong_usage(shell: Any) -> None:
    """Its name and the parts there are."""
    done = shell.run("test", "nonsense")
    assert done.returncode == 2
    assert "nonsense" in done.stderr
    assert "latency" in done.stderr
