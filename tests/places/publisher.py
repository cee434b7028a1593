"""The publishing side in a process of its own: one JSON command a line, one JSON answer a line.

With an endpoint as argument it is another host: it has a link that connects there.
"""

import json
import sys
from typing import Any

import uorb_net as uorb
from communicator import ZenohChannel
from uorb_net import messages


def main() -> None:
    """Serve commands until standard input closes."""
    publications: list[uorb.Publication[Any]] = []
    with uorb.Broker() as broker:
        link = None
        if len(sys.argv) > 1:
            link = uorb.Link(broker, ZenohChannel(connect=[sys.argv[1]]), host="far").start()
        print(json.dumps("ready"), flush=True)
        for line in sys.stdin:
            what, *arguments = json.loads(line)
            answer: Any = None
            if what == "advertise":
                topic, multi, options = arguments
                make = broker.advertise_multi if multi else broker.advertise
                publications.append(make(topic, **options))
                answer = [len(publications) - 1, publications[-1].instance]
            elif what == "publish":
                index, rows = arguments
                publication = publications[index]
                cls = messages.type_for_topic(publication.topic)
                for fields in rows:
                    publication.publish(cls(**fields))
            elif what == "wanted" and link is not None:
                publication = publications[arguments[0]]
                answer = bool(link.subscribers(publication.topic, publication.instance))
            elif what == "unadvertise":
                publications[arguments[0]].unadvertise()
            print(json.dumps(answer), flush=True)


if __name__ == "__main__":
    main()
