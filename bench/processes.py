"""Round trip between two processes of a host, against two bare pipes with the same codec."""

import os
import sys

import uorb_net as uorb
from bench.echo import SIZE, Bus, Child, answer, exchange, pinned, runtime_folder, serve
from bench.ratios import Row, alternate, print_table, row

GOAL = 1.9
ROUNDS = 15


def run(seconds: float = 4.0) -> list[Row]:
    """Measure with both ends on one CPU, and with an end per CPU where there are two."""
    cpus = sorted(os.sched_getaffinity(0))[:2]
    placements = {"both on one CPU": cpus[0], "an end per CPU": cpus[-1]}
    return [_measure(name, cpus[0], cpu, seconds / 2) for name, cpu in placements.items()]


def _measure(name: str, near: int, far: int, seconds: float) -> Row:
    with runtime_folder() as folder, pinned(near):
        os.environ["UORB_RUNTIME_DIR"] = folder
        with uorb.Broker("bench") as broker:
            bus = Bus(broker, near=True)
            child = Child("bench.processes", far)

            def over_bus(n: int) -> float:
                child.serve("bus", n)
                return bus.exchange(n)

            def over_pipe(n: int) -> float:
                child.serve("pipe", n)
                return exchange(lambda data: os.write(child.write_fd, data), lambda: os.read(child.read_fd, SIZE), n)

            n = max(50, int(200 * seconds))
            measured = alternate(over_bus, over_pipe, ROUNDS, n)
            child.close()
        del os.environ["UORB_RUNTIME_DIR"]
    return row(f"round trip, {name} / two pipes", measured, GOAL)


def _child(cpu: int, read_fd: int, write_fd: int) -> None:
    os.sched_setaffinity(0, {cpu})
    with uorb.Broker("bench") as broker:
        bus = Bus(broker, near=False)
        serve(
            {
                "bus": bus.answer,
                "pipe": lambda n: answer(lambda data: os.write(write_fd, data), lambda: os.read(read_fd, SIZE), n),
            }
        )


if __name__ == "__main__":
    if len(sys.argv) > 1:
        _child(*map(int, sys.argv[1:4]))
    else:
        print_table(run())
