"""A subscriber process on the companion: polls some topics, copies every sample, writes what it got as JSON.

Arguments: output file, then topics as NAME or NAME.INSTANCE. Ends when a line comes on standard input.
"""

import json
import sys
from threading import Thread
from typing import Any

import uorb_net as uorb


def flat(value: Any) -> Any:
    """Return a message as JSON can hold it; bytes as a list."""
    if isinstance(value, bytes):
        return list(value)
    if isinstance(value, tuple):
        return [flat(item) for item in value]
    if hasattr(value, "__struct_fields__"):
        return {name: flat(getattr(value, name)) for name in value.__struct_fields__}
    return value


def main() -> None:
    """Subscribe as soon as each topic appears, then copy until told to stop."""
    ended: list[str] = []
    Thread(target=lambda: ended.append(sys.stdin.readline()), daemon=True).start()
    wanted = [(name.partition(".")[0], int(name.partition(".")[2] or 0)) for name in sys.argv[2:]]
    rows: dict[str, list[Any]] = {name: [] for name in sys.argv[2:]}
    names: dict[uorb.Subscription[Any], str] = {}
    with uorb.Broker() as broker:
        print("ready", flush=True)
        while not ended:
            if len(names) < len(wanted):
                known = {(status.topic, status.instance) for status in broker.topics()}
                for key in wanted:
                    if key in known and _name(key) not in names.values():
                        made = broker.subscribe(*key, definition="publisher", start="oldest")
                        names[made] = _name(key)
            for subscription in uorb.poll(list(names), 0.02):
                while subscription.check():
                    rows[names[subscription]].append(flat(subscription.copy()))
        on_the_way = {_name((s.status.topic, s.status.instance)): s.link_lost for s in broker.survey()}
        lost = {name: subscription.lost + on_the_way[name] for subscription, name in names.items()}
    with open(sys.argv[1], "w") as out:
        json.dump({"rows": rows, "lost": lost}, out)


def _name(key: tuple[str, int]) -> str:
    return f"{key[0]}.{key[1]}" if key[1] else key[0]


if __name__ == "__main__":
    main()
