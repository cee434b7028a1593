"""The companion's own attitude: a complementary filter after Mahony (IEEE TAC 53-5, 2008).

Gyro rates carry the attitude; the accelerometer, freed of the vehicle's motion by its velocity as PX4's
attitude_estimator_q does it, pulls roll and pitch; the magnetometer, where there is one, pulls yaw.
"""

from bisect import bisect_left
from collections import deque
from math import atan2, degrees, hypot

from .rotations import (
    ZERO,
    Quaternion,
    Vector,
    add,
    aligned,
    angle_between,
    cross,
    from_euler,
    to_body,
    to_earth,
    turned,
    unit,
    wrapped,
)

TILT_GAIN = 0.4  # 1/s
YAW_GAIN = 0.3
BIAS_GAIN = 0.03  # 1/s^2
BIAS_MAX = 0.05  # rad/s
EAGER = 20.0  # times the gains at the beginning, where it is a guess
EAGER_TIME = 1.0  # s
STEP_MAX = 0.1  # s: a longer pause is a gap in the data, not a rotation
VELOCITY_SPAN = 0.015  # s over which an acceleration is taken from two velocities
VELOCITY_OLD = 0.5  # s
DOWN: Vector = (0.0, 0.0, 1.0)
GRAVITY = 9.80665


class Estimator:
    """An attitude from samples; times are seconds of the sender's clock.

    It begins once it has the magnetic field and an acceleration, or a heading.

    Args:
        field: the earth's magnetic field north, east, down; its direction alone counts.

    Attributes:
        q: the attitude, None while unknown.
        bias: the gyro's, as learnt so far (rad/s).
    """

    def __init__(self, field: Vector = (1.0, 0.0, 0.0)) -> None:
        self.q: Quaternion | None = None
        self.bias: Vector = (0.0, 0.0, 0.0)
        self._field = field
        self._time = self._eager_until = 0.0
        self._velocity: tuple[float, Vector] | None = None
        self._acceleration: Vector | None = None
        self._yaw_error = 0.0
        self._magnetic: Vector | None = None
        self._heading: float | None = None

    def velocity(self, time: float, velocity: Vector) -> None:
        """Take the vehicle's velocity (m/s north, east, down)."""
        if self._velocity is None:
            self._velocity = (time, velocity)
            return
        span = time - self._velocity[0]
        if span >= VELOCITY_SPAN or span < 0.0:
            change = add(velocity, self._velocity[1], -1.0)
            self._acceleration = add(ZERO, change, 1.0 / span) if 0.0 < span < VELOCITY_OLD else None
            self._velocity = (time, velocity)

    def magnetic(self, field: Vector) -> None:
        """Take the magnetic field along the body axes."""
        self._magnetic = field
        if self.q is not None:
            self._yaw_error = self._error_of_yaw(self.q, field)

    def heading(self, yaw: float) -> None:
        """Take a heading (rad) to begin with where no magnetometer gives one."""
        self._heading = yaw

    def inertial(self, time: float, gyro: Vector, force: Vector) -> Quaternion | None:
        """Take mean body rates (rad/s) and specific force (m/s^2); return the attitude, if known."""
        dt, self._time = time - self._time, time
        if self.q is None:
            self._begin(time, force)
        elif 0.0 < dt <= STEP_MAX:
            self.q = self._step(self.q, dt, gyro, force)
        return self.q

    def _begin(self, time: float, force: Vector) -> None:
        if self._magnetic is not None and self._acceleration is not None:
            felt = add(self._acceleration, DOWN, -GRAVITY)
            self.q = aligned((force, self._magnetic), (felt, self._field))
        elif self._heading is not None:  # as if it did not accelerate; what is wrong in that soon goes
            roll = atan2(-force[1], -force[2])
            self.q = from_euler(roll, atan2(force[0], hypot(force[1], force[2])), self._heading)
            self._eager_until = time + EAGER_TIME

    def _error_of_yaw(self, q: Quaternion, field: Vector) -> float:
        north, east, _ = to_earth(q, field)
        return wrapped(atan2(east, north) - atan2(self._field[1], self._field[0]))

    def _step(self, q: Quaternion, dt: float, gyro: Vector, force: Vector) -> Quaternion:
        eager = EAGER if self._time < self._eager_until else 1.0
        down = to_body(q, DOWN)
        gravity = add(to_body(q, self._acceleration or ZERO), force, -1.0)
        # Far from one g the motion is not known well enough to tell which way is down.
        trust = TILT_GAIN if 0.7 < hypot(*gravity) / GRAVITY < 1.3 else 0.0
        pull = add(ZERO, cross(unit(gravity), down), trust)
        pull = add(pull, down, -YAW_GAIN * self._yaw_error)
        if eager == 1.0:
            self.bias = _limited(add(self.bias, pull, -BIAS_GAIN / TILT_GAIN * dt))
        rates = add(add(gyro, self.bias, -1.0), pull, eager)
        # The heading's error shrinks by what was just turned, until the next reading.
        self._yaw_error *= 1.0 - min(eager * YAW_GAIN * dt, 1.0)
        return turned(q, rates, dt)


def _limited(v: Vector) -> Vector:
    x, y, z = (min(max(part, -BIAS_MAX), BIAS_MAX) for part in v)
    return (x, y, z)


class Comparison:
    """Sets estimates beside the vehicle's own attitude of the same moment.

    `latest` is the last pair (vehicle, own); `worst`, `mean` are degrees of the rotation between.
    """

    TOLERANCE = 0.01  # s between the two moments
    SETTLED = 2.0  # s: what the filter does before it has settled is not judged

    def __init__(self) -> None:
        self.latest: tuple[Quaternion, Quaternion] | None = None
        self.count = 0
        self.worst = 0.0
        self._sum = 0.0
        self._own: deque[tuple[float, Quaternion]] = deque(maxlen=256)
        self._waiting: deque[tuple[float, Quaternion]] = deque(maxlen=256)
        self._first: float | None = None

    @property
    def mean(self) -> float:
        """Mean difference in degrees."""
        return self._sum / self.count if self.count else 0.0

    def own(self, time: float, q: Quaternion) -> None:
        """Take an estimate, and judge the vehicle's attitudes up to its moment."""
        self._first = time if self._first is None else self._first
        self._own.append((time, q))
        while self._waiting and self._waiting[0][0] <= time:
            self._judge(*self._waiting.popleft())

    def vehicle(self, time: float, q: Quaternion) -> None:
        """Take the vehicle's attitude."""
        if self._own and time <= self._own[-1][0]:
            self._judge(time, q)
        else:
            self._waiting.append((time, q))

    def _judge(self, time: float, q: Quaternion) -> None:
        at = bisect_left(self._own, (time,))
        near = [self._own[i] for i in (at - 1, at) if 0 <= i < len(self._own)]
        moment, own = min(near, key=lambda pair: abs(pair[0] - time))
        if abs(moment - time) > self.TOLERANCE:
            return
        self.latest = (q, own)
        if self._first is not None and time - self._first >= self.SETTLED:
            difference = degrees(angle_between(q, own))
            self.count += 1
            self._sum += difference
            self.worst = max(self.worst, difference)
