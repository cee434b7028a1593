"""Who flies the simulated vehicle: a course of climbing circles, and a controller that keeps to it.

Velocity error -> wanted acceleration -> wanted thrust direction -> body rates -> torques -> motors.
"""

from math import atan2, cos, hypot, pi, sin

from .rotations import Vector, add, to_body, to_earth, unit, wrapped, yaw_of
from .vehicle import DRAG, GRAVITY, INERTIA, MASS, MOTOR_THRUST, Motors, State, mix

IDLE = 0.5  # s on the ground before the motors speed up
RADIUS = 16.0  # m
SPEED = 9.0  # m/s along the circle: a bank of 27 degrees
HEIGHT = 15.0  # m, the circle's middle
SWING = 5.0  # m up and down
SWING_TIME = 20.0  # s
CLIMB = 4.0  # m/s at most

_VELOCITY_GAIN = 2.0  # 1/s
_TILT_GAIN = 7.0
_YAW_GAIN = 2.0
_RATE_GAIN: Vector = (20.0, 20.0, 8.0)
_LEAN = 8.0  # m/s^2 of horizontal acceleration at most
_YAW_TORQUE_MAX = 0.08  # N m: turning must not take the lift


def fly(state: State) -> Motors:
    """Return the motor commands for a state."""
    if state.time < IDLE:
        return (0.05, 0.05, 0.05, 0.05)
    wanted = _acceleration(state)
    thrust = add(wanted, (0.0, 0.0, -GRAVITY))
    down = to_body(state.q, unit((-thrust[0], -thrust[1], -thrust[2])))
    along = to_earth(state.q, (0.0, 0.0, -1.0))
    lift = MASS * sum(a * b for a, b in zip(thrust, along))
    lift = min(max(lift, 0.1 * MASS * GRAVITY), 3.2 * MOTOR_THRUST)
    # Turning the body's down axis onto the wanted one is a rotation about their vector product.
    rates = (-_TILT_GAIN * down[1], _TILT_GAIN * down[0], _turn(state))
    return mix(lift, _torque(rates, state.rates))


def _torque(wanted: Vector, rates: Vector) -> Vector:
    x, y, z = (i * k * (w - r) for i, k, w, r in zip(INERTIA, _RATE_GAIN, wanted, rates))
    return (x, y, min(max(z, -_YAW_TORQUE_MAX), _YAW_TORQUE_MAX))


def course(state: State) -> Vector:
    """Return the wanted velocity: round the start, drawn to the circle, up and down slowly."""
    north, east, down = state.position
    bearing = atan2(east, north)
    outward = min(max(0.5 * (RADIUS - hypot(north, east)), -4.0), 4.0)
    phase = 2 * pi * state.time / SWING_TIME
    height = HEIGHT + SWING * sin(phase)
    swing = SWING * 2 * pi / SWING_TIME * cos(phase)
    climb = min(max(0.8 * (height + down) + swing, -CLIMB), CLIMB)
    speed = SPEED * min(max(-down / 5.0, 0.0), 1.0)  # no circling near the ground
    outward *= speed / SPEED
    return (
        outward * cos(bearing) - speed * sin(bearing),
        outward * sin(bearing) + speed * cos(bearing),
        -climb,
    )


def _acceleration(state: State) -> Vector:
    wanted = course(state)
    vx, vy, _ = state.velocity
    turn = hypot(vx, vy) / RADIUS  # rad/s on the circle; its pull towards the middle is known beforehand
    x, y, z = add(wanted, state.velocity, -1.0)
    ahead = (-vy * turn + DRAG / MASS * vx, vx * turn + DRAG / MASS * vy)
    x, y = _VELOCITY_GAIN * x + ahead[0], _VELOCITY_GAIN * y + ahead[1]
    shrink = min(1.0, _LEAN / max(hypot(x, y), 1e-9))
    return (x * shrink, y * shrink, min(max(_VELOCITY_GAIN * z, -4.0), 4.0))


def _turn(state: State) -> float:
    """Return the yaw rate that brings the nose to where the vehicle goes."""
    vx, vy, _ = state.velocity
    speed = hypot(vx, vy)
    if speed < 1.0:
        return 0.0
    ahead = wrapped(atan2(vy, vx) - yaw_of(state.q))
    return min(max(_YAW_GAIN * ahead + speed / RADIUS, -1.5), 1.5)
