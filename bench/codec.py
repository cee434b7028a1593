"""Encoding and decoding against hand-written ``struct`` code and against pycdr2.

Two messages: *sensor*, 48 bytes, 10 fields of which two are ``float32[3]``; *odometry*, 252 bytes with
58 float32. Messages in, messages out; each round goes through many different ones.
"""

import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from random import Random
from typing import Any

import msgspec
import pycdr2
from pycdr2.types import array, float32, int32, uint8, uint32, uint64

from bench.ratios import Row, Timed, alternate, count_for, print_table, row, timed
from uorb_net import messages

GOAL_HAND_WRITTEN = 1.5
GOAL_PYCDR2 = 1 / 15
ROUNDS = 15
BATCH = 64

SENSOR = """
uint64 timestamp
float32[3] gyro_rad
uint32 gyro_integral_dt
int32 accelerometer_timestamp_relative
float32[3] accelerometer_m_s2
uint32 accelerometer_integral_dt
uint8 accelerometer_clipping
uint8 gyro_clipping
uint8 accel_calibration_count
uint8 gyro_calibration_count
"""

ODOMETRY = """
uint64 timestamp
uint64 timestamp_sample
float32 x
float32 y
float32 z
float32[4] q
float32[4] q_offset
float32[21] pose_covariance
float32 vx
float32 vy
float32 vz
float32 rollspeed
float32 pitchspeed
float32[21] velocity_covariance
uint8 local_frame
uint8 velocity_frame
uint8 reset_counter
uint8 quality
"""


class Sensor(msgspec.Struct, frozen=True):
    """The plain struct that the hand-written sensor code works on."""

    timestamp: int
    gyro_rad: tuple[float, ...]
    gyro_integral_dt: int
    accelerometer_timestamp_relative: int
    accelerometer_m_s2: tuple[float, ...]
    accelerometer_integral_dt: int
    accelerometer_clipping: int
    gyro_clipping: int
    accel_calibration_count: int
    gyro_calibration_count: int


class Odometry(msgspec.Struct, frozen=True):
    """The plain struct that the hand-written odometry code works on."""

    timestamp: int
    timestamp_sample: int
    x: float
    y: float
    z: float
    q: tuple[float, ...]
    q_offset: tuple[float, ...]
    pose_covariance: tuple[float, ...]
    vx: float
    vy: float
    vz: float
    rollspeed: float
    pitchspeed: float
    velocity_covariance: tuple[float, ...]
    local_frame: int
    velocity_frame: int
    reset_counter: int
    quality: int


_sensor = struct.Struct("<IQ3fIi3fI4B")
_odometry = struct.Struct("<IQQ3f4f4f21f5f21f4B")


def encode_sensor(m: Sensor) -> bytes:
    """Encode by hand."""
    gx, gy, gz = m.gyro_rad
    ax, ay, az = m.accelerometer_m_s2
    return _sensor.pack(
        256,
        m.timestamp,
        gx,
        gy,
        gz,
        m.gyro_integral_dt,
        m.accelerometer_timestamp_relative,
        ax,
        ay,
        az,
        m.accelerometer_integral_dt,
        m.accelerometer_clipping,
        m.gyro_clipping,
        m.accel_calibration_count,
        m.gyro_calibration_count,
    )


def decode_sensor(data: bytes) -> Sensor:
    """Decode by hand."""
    _, t, gx, gy, gz, gdt, relative, ax, ay, az, adt, c0, c1, c2, c3 = _sensor.unpack_from(data, 0)
    return Sensor(t, (gx, gy, gz), gdt, relative, (ax, ay, az), adt, c0, c1, c2, c3)


def encode_odometry(m: Odometry) -> bytes:
    """Encode by hand."""
    return _odometry.pack(
        256,
        m.timestamp,
        m.timestamp_sample,
        m.x,
        m.y,
        m.z,
        *m.q,
        *m.q_offset,
        *m.pose_covariance,
        m.vx,
        m.vy,
        m.vz,
        m.rollspeed,
        m.pitchspeed,
        *m.velocity_covariance,
        m.local_frame,
        m.velocity_frame,
        m.reset_counter,
        m.quality,
    )


def decode_odometry(data: bytes) -> Odometry:
    """Decode by hand."""
    t = _odometry.unpack_from(data, 0)
    return Odometry(
        t[1],
        t[2],
        t[3],
        t[4],
        t[5],
        t[6:10],
        t[10:14],
        t[14:35],
        t[35],
        t[36],
        t[37],
        t[38],
        t[39],
        t[40:61],
        t[61],
        t[62],
        t[63],
        t[64],
    )


@dataclass
class CdrSensor(pycdr2.IdlStruct):  # type: ignore[misc]
    """The sensor message as pycdr2 wants it."""

    timestamp: uint64
    gyro_rad: array[float32, 3]
    gyro_integral_dt: uint32
    accelerometer_timestamp_relative: int32
    accelerometer_m_s2: array[float32, 3]
    accelerometer_integral_dt: uint32
    accelerometer_clipping: uint8
    gyro_clipping: uint8
    accel_calibration_count: uint8
    gyro_calibration_count: uint8


def samples(kind: type[messages.Message]) -> list[Any]:
    """Return a batch of random messages whose floats are float32 values."""
    info = kind.__uorb__
    random = Random(1)
    made = []
    for _ in range(BATCH):
        values: dict[str, Any] = {}
        for member in info.schema.members:
            fractional = member.type == "float32"
            drawn = [
                random.uniform(-9, 9) if fractional else random.randrange(1, 100) for _ in range(member.length or 1)
            ]
            values[member.name] = tuple(drawn) if member.length else drawn[0]
        made.append(info.decode(info.encode(kind(**values), 0), 0))
    return made


def converted(batch: Sequence[Any], target: Callable[..., Any], sequence: type = tuple) -> list[Any]:
    """Return the batch as another class."""
    return [
        target(**{k: sequence(v) if isinstance(v, tuple) else v for k, v in msgspec.structs.asdict(m).items()})
        for m in batch
    ]


def over(batch: Sequence[Any], operation: Callable[[Any], object]) -> Timed:
    """Return the timed loop of a function of one argument over a batch."""

    def loop(n: int) -> None:
        for _ in range(0, n, BATCH):
            for item in batch:
                operation(item)

    return timed(loop)


def over_pair(batch: Sequence[Any], operation: Callable[[Any, int], object]) -> Timed:
    """Return the timed loop of a function that also takes a stamp or an offset, as the bus calls it."""

    def loop(n: int) -> None:
        for _ in range(0, n, BATCH):
            for item in batch:
                operation(item, 0)

    return timed(loop)


def run(seconds: float = 2.0) -> list[Row]:
    """Measure for about so many seconds and return the rows."""
    sensor = messages.from_text("BenchSensor", SENSOR)
    odometry = messages.from_text("BenchOdometry", ODOMETRY)
    each = seconds / 6
    return [
        *_hand_written("sensor", sensor, Sensor, encode_sensor, decode_sensor, each),
        *_hand_written("odometry", odometry, Odometry, encode_odometry, decode_odometry, each),
        *_pycdr2(sensor, each),
    ]


def _hand_written(
    name: str,
    kind: type[messages.Message],
    plain: type[Any],
    encode: Callable[[Any], bytes],
    decode: Callable[[bytes], Any],
    seconds: float,
) -> list[Row]:
    batch = samples(kind)
    twins = converted(batch, plain)
    encoded = [encode(twin) for twin in twins]
    info = kind.__uorb__
    assert encoded == [info.encode(message, 0) for message in batch]
    assert [decode(data) for data in encoded] == twins
    return [
        _row(f"encode {name} / hand-written", over_pair(batch, info.encode), over(twins, encode), seconds),
        _row(f"decode {name} / hand-written", over_pair(encoded, info.decode), over(encoded, decode), seconds),
    ]


def _pycdr2(kind: type[messages.Message], seconds: float) -> list[Row]:
    batch = samples(kind)
    twins = converted(batch, CdrSensor, list)
    info = kind.__uorb__
    encoded = [info.encode(message, 0) for message in batch]
    assert encoded == [twin.serialize() for twin in twins]
    ours = over_pair(batch, info.encode), over_pair(encoded, info.decode)
    theirs = over(twins, CdrSensor.serialize), over(encoded, CdrSensor.deserialize)
    return [
        _row("encode sensor / pycdr2", ours[0], theirs[0], seconds, GOAL_PYCDR2),
        _row("decode sensor / pycdr2", ours[1], theirs[1], seconds, GOAL_PYCDR2),
    ]


def _row(name: str, ours: Timed, control: Timed, seconds: float, goal: float = GOAL_HAND_WRITTEN) -> Row:
    n = max(BATCH, count_for(control, seconds / (2 * ROUNDS)) // BATCH * BATCH)
    measured = alternate(ours, control, ROUNDS, n)
    return row(name, measured, goal, f"{1 / measured.ratio:.0f} times faster" if goal < 1 else "")


if __name__ == "__main__":
    print_table(run())
