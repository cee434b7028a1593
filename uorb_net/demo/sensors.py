"""What the vehicle's sensors read: the truth with noise and constant errors, from one generator.

Pure arithmetic. Figures are those of a small autopilot board: a MEMS IMU, a barometer, a
magnetometer, one GNSS receiver.
"""

from math import atan2, cos, degrees, hypot, radians
from random import Random
from typing import NamedTuple

from .rotations import Vector, add, to_body
from .vehicle import GRAVITY, State

HOME = (47.3977419, 8.5455938, 488.0)  # latitude, longitude (deg), metres above mean sea level
EARTH_RADIUS = 6_371_000.0
#: The magnetic field there (Gauss north, east, down), as a world magnetic model gives it.
FIELD: Vector = (0.214, 0.011, 0.430)

_GYRO_NOISE = 0.004  # rad/s per sample
_GYRO_BIAS = 0.01
_ACCEL_NOISE = 0.08  # m/s^2 per sample
_ACCEL_BIAS = 0.03
_MAG_NOISE = 0.003  # Gauss
_BARO_NOISE = 4.0  # Pa
_GPS_NOISE = 0.4  # m
_GPS_SPEED_NOISE = 0.05  # m/s


class Fix(NamedTuple):
    """What a GNSS receiver reports: degrees, metres above mean sea level, m/s north, east, down."""

    latitude: float
    longitude: float
    altitude: float
    velocity: Vector

    @property
    def speed(self) -> float:
        """Speed over ground."""
        return hypot(self.velocity[0], self.velocity[1])

    @property
    def course(self) -> float:
        """Course over ground from north (rad)."""
        return atan2(self.velocity[1], self.velocity[0])


def specific_force(state: State) -> Vector:
    """Return what an ideal accelerometer reads (m/s^2): minus one g along the down axis at rest."""
    return to_body(state.q, add(state.acceleration, (0.0, 0.0, -GRAVITY)))


def global_position(position: Vector) -> Vector:
    """Return latitude, longitude (deg) and altitude of a local position (m), on a sphere."""
    north, east, down = position
    longitude = HOME[1] + degrees(east / (EARTH_RADIUS * cos(radians(HOME[0]))))
    return (HOME[0] + degrees(north / EARTH_RADIUS), longitude, HOME[2] - down)


def pressure(altitude: float) -> float:
    """Return the standard atmosphere's pressure (Pa) at metres above mean sea level."""
    return float(101_325.0 * (1.0 - 2.25577e-5 * altitude) ** 5.25588)


class Sensors:
    """The sensors of one vehicle; what stays wrong all the flight is drawn once."""

    def __init__(self, random: Random) -> None:
        self._random = random
        self.gyro_bias = self._spread(_GYRO_BIAS)
        self._accel_biases = [self._spread(_ACCEL_BIAS) for _ in range(2)]

    def gyro(self, state: State) -> Vector:
        """Return body rates (rad/s)."""
        return add(self._noisy(state.rates, _GYRO_NOISE), self.gyro_bias)

    def accelerometer(self, state: State, instance: int = 0) -> Vector:
        """Return the specific force (m/s^2) as accelerometer `instance` reads it."""
        return add(self._noisy(specific_force(state), _ACCEL_NOISE), self._accel_biases[instance])

    def magnetometer(self, state: State) -> Vector:
        """Return the field along the body axes (Gauss)."""
        return self._noisy(to_body(state.q, FIELD), _MAG_NOISE)

    def barometer(self, state: State) -> float:
        """Return the static pressure (Pa)."""
        return pressure(HOME[2] - state.position[2]) + self._random.gauss(0.0, _BARO_NOISE)

    def gps(self, state: State) -> Fix:
        """Return a position fix."""
        position = self._noisy(state.position, _GPS_NOISE)
        return Fix(*global_position(position), self._noisy(state.velocity, _GPS_SPEED_NOISE))

    def _noisy(self, v: Vector, sigma: float) -> Vector:
        gauss = self._random.gauss
        return (v[0] + gauss(0.0, sigma), v[1] + gauss(0.0, sigma), v[2] + gauss(0.0, sigma))

    def _spread(self, most: float) -> Vector:
        uniform = self._random.uniform
        return (uniform(-most, most), uniform(-most, most), uniform(-most, most))
