"""Round trip between two processes of a host, against two bare pipes and pyzmq over ipc, with the same codec."""

import os
import sys
from typing import Any

import zmq

import uorb_net as uorb
from bench.echo import SIZE, Bus, Child, answer, exchange, pinned, runtime_folder, serve
from bench.ratios import Row, alternate, print_table, row

GOAL = 1.9
GOAL_ZMQ = 0.55  # on one CPU; with an end per CPU both mostly wait for the other CPU to wake
ROUNDS = 15


def run(seconds: float = 4.0) -> list[Row]:
    """Measure with both ends on one CPU, and with an end per CPU where there are two."""
    cpus = sorted(os.sched_getaffinity(0))[:2]
    placements = {"both on one CPU": cpus[0], "an end per CPU": cpus[-1]}
    return [line for name, cpu in placements.items() for line in _measure(name, cpus[0], cpu, seconds / 2)]


def _measure(name: str, near: int, far: int, seconds: float) -> list[Row]:
    with runtime_folder() as folder, pinned(near):
        os.environ["UORB_RUNTIME_DIR"] = folder
        with uorb.Broker("bench") as broker:
            bus = Bus(broker, near=True)
            child = Child("bench.processes", far, folder)
            pair = _pair(folder, near=True)

            def over_bus(n: int) -> float:
                child.serve("bus", n)
                return bus.exchange(n)

            def over_pipe(n: int) -> float:
                child.serve("pipe", n)
                return exchange(lambda data: os.write(child.write_fd, data), lambda: os.read(child.read_fd, SIZE), n)

            def over_zmq(n: int) -> float:
                child.serve("zmq", n)
                return exchange(pair.send, pair.recv, n)

            n = max(50, int(200 * seconds))
            rows = [row(f"round trip, {name} / two pipes", alternate(over_bus, over_pipe, ROUNDS, n), GOAL)]
            if near == far:
                against = alternate(over_bus, over_zmq, ROUNDS, n)
                rows.append(row(f"round trip, {name} / pyzmq ipc", against, GOAL_ZMQ))
            pair.close(0)
            child.close()
        del os.environ["UORB_RUNTIME_DIR"]
    return rows


def _pair(folder: str, near: bool) -> Any:
    """Return one end of a pair of sockets."""
    pair: Any = zmq.Context.instance().socket(zmq.PAIR)
    (pair.bind if near else pair.connect)(f"ipc://{folder}/pair")
    return pair


def _child(cpu: int, read_fd: int, write_fd: int, folder: str) -> None:
    os.sched_setaffinity(0, {cpu})
    pair = _pair(folder, near=False)
    with uorb.Broker("bench") as broker:
        bus = Bus(broker, near=False)
        serve(
            {
                "bus": bus.answer,
                "zmq": lambda n: answer(pair.send, pair.recv, n),
                "pipe": lambda n: answer(lambda data: os.write(write_fd, data), lambda: os.read(read_fd, SIZE), n),
            }
        )


if __name__ == "__main__":
    if len(sys.argv) > 1:
        _child(int(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3]), sys.argv[4])
    else:
        print_table(run())
