"""The host `companion`: reads the autopilot's topics on its own bus and estimates the attitude from them.

In the simulation it publishes its estimate and its own load, which the autopilot receives.
"""

from math import degrees, isfinite
from time import monotonic
from typing import Any

from .. import msg
from ..subscription import Subscription
from .estimator import Comparison, Estimator
from .host import NAP, Host, run
from .load import Load
from .reports import Attitude
from .rotations import Vector, to_euler, yaw_of
from .sensors import FIELD
from .telemetry import depth

ESTIMATE_HZ = 20
LOOK_HZ = 10


class Observer:
    """Feeds the estimator with what arrives, by the fields it knows.

    Args:
        magnetic: whether `sensor_mag` may be believed; a log's is not calibrated.
    """

    def __init__(self, *, magnetic: bool) -> None:
        self.estimator = Estimator(FIELD)
        self.comparison = Comparison()
        self._takers = {
            "sensor_combined": self._inertial,
            "vehicle_attitude": self._attitude,
            "vehicle_local_position": self._position,
        }
        if magnetic:
            self._takers["sensor_mag"] = self._magnetic
        self._magnetic_heading = magnetic

    def take(self, subscription: Subscription[Any], message: Any) -> None:
        """Take a sample; topics, instances and fields that mean nothing here are passed over."""
        taker = self._takers.get(subscription.topic)
        if taker is None or subscription.instance:
            return
        try:
            taker(message)
        except (AttributeError, TypeError, ValueError):
            del self._takers[subscription.topic]  # not the fields it has in PX4

    def _inertial(self, message: Any) -> None:
        time, gyro, force = message.timestamp / 1e6, message.gyro_rad, message.accelerometer_m_s2
        if not _finite(*gyro, *force):
            return
        q = self.estimator.inertial(time, gyro, force)
        if q is not None:
            self.comparison.own(time, q)

    def _attitude(self, message: Any) -> None:
        w, x, y, z = message.q
        if not _finite(w, x, y, z):
            return
        if not self._magnetic_heading:
            self.estimator.heading(yaw_of((w, x, y, z)))
        self.comparison.vehicle(_moment(message), (w, x, y, z))

    def _position(self, message: Any) -> None:
        velocity = (message.vx, message.vy, message.vz)
        if message.v_xy_valid and message.v_z_valid and _finite(*velocity):
            self.estimator.velocity(_moment(message), velocity)

    def _magnetic(self, message: Any) -> None:
        self.estimator.magnetic((message.x, message.y, message.z))

    def attitude(self) -> Attitude | None:
        """Return the newest comparison."""
        latest, account = self.comparison.latest, self.comparison
        if latest is None:
            return None
        vehicle, own = (_in_degrees(to_euler(q)) for q in latest)
        return Attitude(vehicle, own, account.mean, account.worst, account.count)


def _moment(message: Any) -> float:
    """Return when the data was taken, in seconds; old definitions have only the time of publication."""
    return float(getattr(message, "timestamp_sample", 0) or message.timestamp) / 1e6


def _finite(*values: float) -> bool:
    """Tell whether all are numbers: one NaN of a log would stay in the filter for ever."""
    return all(map(isfinite, values))


def _in_degrees(v: Vector) -> Vector:
    return (degrees(v[0]), degrees(v[1]), degrees(v[2]))


def _watch(host: Host) -> None:
    observer = Observer(magnetic=not host.plan.log)
    host.receiver.listener, host.attitude = observer.take, observer.attitude
    host.connect()
    if not host.plan.log:  # a log may hold the same topics under other definitions
        _contribute(host, observer)


def _contribute(host: Host, observer: Observer) -> None:
    """Publish the estimate and this computer's load until the parent wants quiet."""
    estimate = host.broker.advertise("estimator_attitude", queue_length=depth(ESTIMATE_HZ))
    computer = host.broker.advertise_multi("onboard_computer_status", queue_length=depth(1))
    load, due, number = Load(), monotonic(), 0
    while not host.quiet:
        q = observer.estimator.q
        if q is not None:
            host.publish(estimate, msg.VehicleAttitude(q=q))
        if number % (ESTIMATE_HZ // LOOK_HZ) == 0:
            load.look()
        if number % ESTIMATE_HZ == 0:
            host.publish(computer, msg.OnboardComputerStatus(**load.fields()))
        number += 1
        due = max(due + 1 / ESTIMATE_HZ, monotonic() - NAP)
        host.serve(due)


if __name__ == "__main__":
    raise SystemExit(run(_watch))
