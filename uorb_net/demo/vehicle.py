"""A small quadrotor as pure arithmetic: state in, state out.

A rigid body with four lagging motors, linear air drag in a gusting wind, flat ground, and a battery.
NED earth frame, FRD body frame, SI units. All chance comes from the generator handed in.
"""

from math import sqrt
from random import Random
from typing import NamedTuple

from .rotations import LEVEL, ZERO, Quaternion, Vector, add, cross, to_earth, turned

GRAVITY = 9.80665  # m/s^2
MASS = 1.5  # kg
INERTIA: Vector = (0.020, 0.020, 0.035)  # kg m^2
ARM = 0.25 / sqrt(2)  # m, motors from the centre along each body axis
MOTOR_THRUST = 8.0  # N at full command
MOTOR_LAG = 0.03  # s
MOTOR_CURRENT = 12.0  # A at full command
YAW_TORQUE = 0.016  # N m of reaction per N of thrust
DRAG = 0.25  # N per m/s of air speed
GUST = 1.0  # m/s, one sigma of the wind's swing
GUST_TIME = 4.0  # s
CELLS = 4
CAPACITY = 5000.0  # mAh
RESISTANCE = 0.03  # ohm, the whole pack

#: PX4's quadrotor X: forward, right, and the sense in which the motor's reaction turns the vehicle.
MOTORS = ((1, 1, 1), (-1, -1, 1), (1, -1, -1), (-1, 1, -1))

Motors = tuple[float, float, float, float]


class State(NamedTuple):
    """The vehicle at one moment.

    `acceleration` is the velocity's rate, gravity included in it: zero at rest. `motors` are 0..1.
    """

    time: float = 0.0
    q: Quaternion = LEVEL
    rates: Vector = ZERO
    position: Vector = ZERO
    velocity: Vector = ZERO
    acceleration: Vector = ZERO
    motors: Motors = (0.0, 0.0, 0.0, 0.0)
    wind: Vector = ZERO
    used_mah: float = 0.0

    @property
    def landed(self) -> bool:
        """Whether it stands on the ground."""
        return self.position[2] >= 0.0 and self.velocity == ZERO

    @property
    def current(self) -> float:
        """Amperes drawn from the battery: the motors' and half an ampere for the electronics."""
        return 0.5 + MOTOR_CURRENT * sum(motor * sqrt(motor) for motor in self.motors)

    @property
    def remaining(self) -> float:
        """State of charge, 0..1."""
        return max(1.0 - self.used_mah / CAPACITY, 0.0)

    @property
    def voltage(self) -> float:
        """Volts at the pack's terminals."""
        return CELLS * (3.3 + 0.9 * self.remaining) - RESISTANCE * self.current


def step(state: State, command: Motors, dt: float, random: Random) -> State:
    """Return the state `dt` seconds later under motor commands of 0..1."""
    motors = _follow(state.motors, command, dt)
    wind = _gust(state.wind, dt, random)
    used = state.used_mah + state.current * dt / 3.6
    acceleration = _acceleration(state, motors, wind)
    velocity = add(state.velocity, acceleration, dt)
    position = add(state.position, velocity, dt)
    if position[2] >= 0.0 and acceleration[2] >= 0.0:  # the ground holds it
        position = (state.position[0], state.position[1], 0.0)
        return State(state.time + dt, state.q, ZERO, position, ZERO, ZERO, motors, wind, used)
    rates = add(state.rates, _angular_acceleration(state.rates, motors), dt)
    q = turned(state.q, rates, dt)
    return State(state.time + dt, q, rates, position, velocity, acceleration, motors, wind, used)


def _follow(motors: Motors, command: Motors, dt: float) -> Motors:
    gain = dt / (MOTOR_LAG + dt)
    a, b, c, d = (m + gain * (min(max(c, 0.0), 1.0) - m) for m, c in zip(motors, command))
    return (a, b, c, d)


def _gust(wind: Vector, dt: float, random: Random) -> Vector:
    """Let the wind wander about zero (Ornstein-Uhlenbeck); no gusts up or down."""
    stay = 1.0 - dt / GUST_TIME
    swing = GUST * sqrt(2.0 * dt / GUST_TIME)
    return (stay * wind[0] + random.gauss(0.0, swing), stay * wind[1] + random.gauss(0.0, swing), 0.0)


def _acceleration(state: State, motors: Motors, wind: Vector) -> Vector:
    lift = to_earth(state.q, (0.0, 0.0, -MOTOR_THRUST * sum(motors) / MASS))
    drag = add(wind, state.velocity, -1.0)
    return add(add((0.0, 0.0, GRAVITY), lift), drag, DRAG / MASS)


def _angular_acceleration(rates: Vector, motors: Motors) -> Vector:
    """Euler's equations with the motors' torques."""
    roll = pitch = yaw = 0.0
    for motor, (forward, right, sense) in zip(motors, MOTORS):
        thrust = MOTOR_THRUST * motor
        roll -= right * ARM * thrust
        pitch += forward * ARM * thrust
        yaw += sense * YAW_TORQUE * thrust
    spin = (INERTIA[0] * rates[0], INERTIA[1] * rates[1], INERTIA[2] * rates[2])
    torque = add((roll, pitch, yaw), cross(rates, spin), -1.0)
    return (torque[0] / INERTIA[0], torque[1] / INERTIA[1], torque[2] / INERTIA[2])


def mix(lift: float, torque: Vector) -> Motors:
    """Return the commands that give a lift (N) and torques (N m): the inverse of the sums above."""
    a, b, c, d = (
        (
            lift
            - right * torque[0] / ARM
            + forward * torque[1] / ARM
            + sense * torque[2] / YAW_TORQUE
        ) / (4 * MOTOR_THRUST)
        for forward, right, sense in MOTORS
    )  # fmt: skip
    return (a, b, c, d)
