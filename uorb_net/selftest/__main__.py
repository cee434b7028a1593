"""One process of the self test: `python -m uorb_net.selftest VEHICLE PART`, or `VEHICLE --publisher PART`."""

import subprocess
import sys

from ..broker import Broker
from ..errors import UorbError
from ..orb import set_default_broker
from .parts import PARTS, Failed, run_publisher


def main(vehicle: str, *what: str) -> int:
    """Run a part or be its publisher; the last line printed is the remark or what failed."""
    children = []

    def spawn(part: str) -> None:
        command = [sys.executable, "-m", "uorb_net.selftest", vehicle, "--publisher", part]
        children.append(subprocess.Popen(command))

    with Broker(vehicle) as broker:
        set_default_broker(broker)
        if what[0] == "--publisher":
            run_publisher(what[1])
            return 0
        try:
            print(PARTS[what[0]](spawn))
        except (Failed, UorbError) as error:
            print(error)
            return 1
        finally:
            for child in children:
                child.kill()
                child.wait()
    return 0


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
