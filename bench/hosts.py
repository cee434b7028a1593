"""Round trip between two hosts over loopback TCP, against raw Zenoh between the same two processes.

Each process is a host: its own bus and its own link. The control is a Zenoh session in the same
process with the same codec, alternating with ours round by round.
"""

import os
import socket
import sys

import uorb_net as uorb
from bench.echo import Bus, Child, Raw, answer, exchange, runtime_folder, serve
from bench.ratios import Row, alternate, print_table, row
from communicator import ZenohChannel

GOAL = 1.5
ROUNDS = 15


def run(seconds: float = 4.0) -> list[Row]:
    """Measure with the link in the user's process on both sides."""
    ports = [_free_port(), _free_port()]
    with runtime_folder() as near, runtime_folder() as far:
        os.environ["UORB_RUNTIME_DIR"] = near
        with uorb.Broker("bench") as broker:
            link = uorb.Link(broker, ZenohChannel(listen=[f"tcp/127.0.0.1:{ports[0]}"]), host="near").start()
            bus, raw = Bus(broker, near=True), Raw(near=True, port=ports[1])
            child = Child("bench.hosts", -1, *ports, env={"UORB_RUNTIME_DIR": far})
            measured_row = _measure(bus, raw, child, link, seconds)
            child.close()
            raw.close()
        del os.environ["UORB_RUNTIME_DIR"]
    return [measured_row]


def _measure(bus: Bus, raw: Raw, child: Child, link: uorb.Link, seconds: float) -> Row:
    assert link.wait_for_peer("far", 10.0)

    def over_bus(n: int) -> float:
        child.serve("bus", n)
        return bus.exchange(n)

    def over_zenoh(n: int) -> float:
        child.serve("raw", n)
        return exchange(raw.send, raw.receive, n)

    child.serve("meet", 1)
    child.expect("met")
    while not bus.subscription.advertised:
        bus.subscription.wait(0.05)
    measured = alternate(over_bus, over_zenoh, ROUNDS, max(20, int(100 * seconds)))
    lost = link.stats().lost
    return row("round trip between hosts / raw Zenoh", measured, GOAL, f"{lost} lost" if lost else "")


def _child(ports: list[int]) -> None:
    with uorb.Broker("bench") as broker:
        link = uorb.Link(broker, ZenohChannel(connect=[f"tcp/127.0.0.1:{ports[0]}"]), host="far").start()
        bus, raw = Bus(broker, near=False), Raw(near=False, port=ports[1])

        def meet(_: int) -> None:
            """Wait until both topics are mirrored and wanted, so that no first sample is missed."""
            assert link.wait_for_peer("near", 10.0)
            while not bus.subscription.advertised:
                bus.subscription.wait(0.05)
            print("met", flush=True)

        serve({"bus": bus.answer, "raw": lambda n: answer(raw.send, raw.receive, n), "meet": meet})
        raw.close()


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


if __name__ == "__main__":
    if len(sys.argv) > 1:
        _child([int(port) for port in sys.argv[4:6]])
    else:
        print_table(run())
