"""Run all benchmarks, or those named: `python -m bench [codec node processes flow scale hosts]`."""

import sys
from importlib import import_module

from bench.ratios import print_table

ALL = ("codec", "node", "processes", "flow", "scale", "hosts")


def main() -> int:
    """Print a table; 0 whatever the figures are, 2 for an unknown name."""
    names = sys.argv[1:] or list(ALL)
    unknown = [name for name in names if name not in ALL]
    if unknown:
        print(f"no benchmark {unknown[0]!r}: {', '.join(ALL)}", file=sys.stderr)
        return 2
    rows = []
    for name in names:
        print(f"{name} ...", file=sys.stderr, flush=True)
        rows += import_module(f"bench.{name}").run()
    print_table(rows)
    return 0


if __name__ == "__main__":
    sys.exit(main())
