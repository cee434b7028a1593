"""Vectors and attitude quaternions as tuples.

A quaternion is (w, x, y, z), Hamilton convention, and rotates from the body frame (forward, right,
down) to the earth frame (north, east, down), as PX4's `vehicle_attitude.q` does.
"""

from math import asin, atan2, cos, hypot, pi, remainder, sin, sqrt

Vector = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]

ZERO: Vector = (0.0, 0.0, 0.0)
LEVEL: Quaternion = (1.0, 0.0, 0.0, 0.0)


def add(a: Vector, b: Vector, scale: float = 1.0) -> Vector:
    """Return a + scale * b."""
    return (a[0] + scale * b[0], a[1] + scale * b[1], a[2] + scale * b[2])


def cross(a: Vector, b: Vector) -> Vector:
    """Return the vector product."""
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


def unit(a: Vector) -> Vector:
    """Return a at length 1; a zero vector stays as it is."""
    length = hypot(*a)
    return (a[0] / length, a[1] / length, a[2] / length) if length else a


def multiply(a: Quaternion, b: Quaternion) -> Quaternion:
    """Return the rotation b followed by a."""
    aw, ax, ay, az = a
    bw, bx, by, bz = b
    return (
        aw * bw - ax * bx - ay * by - az * bz,
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
    )


def inverse(q: Quaternion) -> Quaternion:
    """Return the opposite rotation of a unit quaternion."""
    return (q[0], -q[1], -q[2], -q[3])


def to_earth(q: Quaternion, v: Vector) -> Vector:
    """Rotate a body vector into the earth frame: v + 2 r x (r x v + w v), r being q's vector part."""
    w, r = q[0], (q[1], q[2], q[3])
    inner = add(cross(r, v), v, w)
    return add(v, cross(r, inner), 2.0)


def to_body(q: Quaternion, v: Vector) -> Vector:
    """Rotate an earth vector into the body frame."""
    return to_earth(inverse(q), v)


def turned(q: Quaternion, rates: Vector, dt: float) -> Quaternion:
    """Return the attitude after `dt` seconds at constant body rates (rad/s), at length 1 again."""
    rate = hypot(*rates)
    half = 0.5 * rate * dt
    scale = sin(half) / rate if rate > 1e-9 else 0.5 * dt
    w, x, y, z = multiply(q, (cos(half), rates[0] * scale, rates[1] * scale, rates[2] * scale))
    length = sqrt(w * w + x * x + y * y + z * z)
    return (w / length, x / length, y / length, z / length)


def from_euler(roll: float, pitch: float, yaw: float) -> Quaternion:
    """Return the attitude of yaw, then pitch, then roll (rad)."""
    about_x = (cos(roll / 2), sin(roll / 2), 0.0, 0.0)
    about_y = (cos(pitch / 2), 0.0, sin(pitch / 2), 0.0)
    about_z = (cos(yaw / 2), 0.0, 0.0, sin(yaw / 2))
    return multiply(multiply(about_z, about_y), about_x)


def aligned(body: tuple[Vector, Vector], earth: tuple[Vector, Vector]) -> Quaternion:
    """Return the attitude in which two body vectors lie along two earth vectors (TRIAD).

    The first pair is met exactly, the second as far as its angle to the first allows.
    """
    r = [
        [sum(e[row] * b[column] for e, b in zip(_triad(*earth), _triad(*body))) for column in range(3)]
        for row in range(3)
    ]
    trace = r[0][0] + r[1][1] + r[2][2]
    squares = (1 + trace, 1 + 2 * r[0][0] - trace, 1 + 2 * r[1][1] - trace, 1 + 2 * r[2][2] - trace)
    x, y, z = r[2][1] - r[1][2], r[0][2] - r[2][0], r[1][0] - r[0][1]
    xy, zx, yz = r[0][1] + r[1][0], r[2][0] + r[0][2], r[1][2] + r[2][1]
    # Each row is the quaternion times four times one of its parts: that of the largest part is the sound one.
    rows = ((squares[0], x, y, z), (x, squares[1], xy, zx), (y, xy, squares[2], yz), (z, zx, yz, squares[3]))
    q = rows[squares.index(max(squares))]
    length = hypot(*q)
    return (q[0] / length, q[1] / length, q[2] / length, q[3] / length)


def _triad(first: Vector, second: Vector) -> tuple[Vector, Vector, Vector]:
    along, across = unit(first), unit(cross(first, second))
    return along, across, cross(along, across)


def to_euler(q: Quaternion) -> Vector:
    """Return roll, pitch and yaw (rad)."""
    w, x, y, z = q
    roll = atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    pitch = asin(max(-1.0, min(1.0, 2 * (w * y - z * x))))
    return roll, pitch, yaw_of(q)


def yaw_of(q: Quaternion) -> float:
    """Return the heading from north (rad)."""
    w, x, y, z = q
    return atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))


def angle_between(a: Quaternion, b: Quaternion) -> float:
    """Return the angle of the one rotation that takes a to b (rad, 0..pi)."""
    w, x, y, z = multiply(inverse(a), b)
    return 2 * atan2(hypot(x, y, z), abs(w))


def wrapped(angle: float) -> float:
    """Return an angle within -pi..pi."""
    return remainder(angle, 2 * pi)
