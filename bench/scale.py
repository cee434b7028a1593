"""What does not grow: publish beside many idle subscriptions or topics, a poll of many, memory."""

import os
import subprocess
import sys
from statistics import median
from typing import Any

import uorb_net as uorb
from bench.echo import runtime_folder, sample
from bench.ratios import Row, Timed, alternate, count_for, print_table, row, timed
from uorb_net import messages
from uorb_net.msg import SensorCombined

ROUNDS = 15
MEMORY = """
def used():
    return int(next(l for l in open('/proc/self/status') if l.startswith('VmRSS')).split()[1]) / 1024
bare = used()
import uorb_net as uorb
broker = uorb.Broker("bench")
kept = [broker.subscribe("sensor_combined", i % 10) for i in range(100)]
print(used() - bare)
"""


def run(seconds: float = 4.0) -> list[Row]:
    """Measure for about so many seconds."""
    with runtime_folder() as folder:
        os.environ["UORB_RUNTIME_DIR"] = folder
        try:
            return [_idle_subscriptions(seconds / 2), _many_topics(seconds / 2), _memory()]
        finally:
            del os.environ["UORB_RUNTIME_DIR"]


def _publish(publication: "uorb.Publication[Any]") -> Timed:
    def loop(n: int) -> None:
        publish = publication.publish
        for number in range(n):
            publish(sample(number))

    return timed(loop)


def _idle_subscriptions(seconds: float) -> Row:
    with uorb.Broker("one") as one, uorb.Broker("hundred") as hundred:
        kept = [one.subscribe(SensorCombined), *(hundred.subscribe(SensorCombined) for _ in range(100))]
        few, many = _publish(one.advertise(SensorCombined)), _publish(hundred.advertise(SensorCombined))
        n = count_for(few, seconds / (2 * ROUNDS))
        measured = alternate(many, few, ROUNDS, n)
        del kept
    return row("publish with 100 idle subscriptions / with 1", measured, 2.0)


def _many_topics(seconds: float) -> Row:
    kinds = [messages.from_text(f"Topic{n}", "uint64 timestamp\nfloat32 value\n") for n in range(1000)]
    with uorb.Broker("one") as one, uorb.Broker("thousand") as thousand:
        kept = [thousand.advertise(kind) for kind in kinds]
        few, many = _publish(one.advertise(SensorCombined)), _publish(thousand.advertise(SensorCombined))
        n = count_for(few, seconds / (2 * ROUNDS))
        measured = alternate(many, few, ROUNDS, n)
        del kept
    return row("publish with 1000 topics / with 1", measured, 1.2)


def _memory() -> Row:
    """Return the memory of a process with 100 subscriptions, in MB over bare Python, as a share of 40."""
    used = [
        float(subprocess.run([sys.executable, "-c", MEMORY], capture_output=True, text=True, check=True).stdout)
        for _ in range(3)
    ]
    figure = median(used)
    return Row("memory of 100 subscriptions / 40 MB", figure / 40, 1.0, 0.0, 0.0, f"{figure:.1f} MB over bare Python")


if __name__ == "__main__":
    print_table(run())
