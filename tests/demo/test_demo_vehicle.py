"""The simulated vehicle: laws of physics it keeps, sensors that tell of it, rates it publishes at."""

from collections import Counter
from math import cos, degrees, hypot, pi
from random import Random
from typing import Any, cast

import pytest

import uorb_net as uorb
from uorb_net.demo import vehicle
from uorb_net.demo.autopilot import Flight
from uorb_net.demo.host import Host
from uorb_net.demo.load import memory, processor_ticks
from uorb_net.demo.pilot import HEIGHT, RADIUS, SPEED, SWING
from uorb_net.demo.rotations import aligned, angle_between, from_euler, to_body, to_earth, to_euler
from uorb_net.demo.sensors import HOME, Sensors, global_position, pressure, specific_force
from uorb_net.demo.telemetry import INTERVAL_US, RATE, Telemetry
from uorb_net.demo.vehicle import GRAVITY, MASS, MOTOR_THRUST, State, mix, step

STILL = Random(0)


def hover() -> float:
    """Return the command that carries the weight."""
    return MASS * GRAVITY / (4 * MOTOR_THRUST)


def test_at_rest_the_accelerometer_reads_minus_g() -> None:
    """On the ground, motors off: the ground pushes up with one g, along minus z."""
    state = step(State(), (0.0, 0.0, 0.0, 0.0), 0.0025, Random(1))
    assert state.landed
    assert state.q == (1.0, 0.0, 0.0, 0.0)
    assert specific_force(state) == pytest.approx((0.0, 0.0, -GRAVITY))


def test_in_a_hover_the_accelerometer_reads_minus_g(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without wind the motors' lift is all there is to feel, and nothing moves."""
    monkeypatch.setattr(vehicle, "GUST", 0.0)
    motors = (hover(),) * 4
    state = State(position=(0.0, 0.0, -10.0), motors=motors)
    for _ in range(400):
        state = step(state, motors, 0.0025, STILL)
    assert specific_force(state) == pytest.approx((0.0, 0.0, -GRAVITY))
    assert state.position == pytest.approx((0.0, 0.0, -10.0))


def test_in_free_fall_the_accelerometer_reads_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """Motors off in the air: only the drag of the beginning fall."""
    monkeypatch.setattr(vehicle, "GUST", 0.0)
    state = step(State(position=(0.0, 0.0, -10.0)), (0.0, 0.0, 0.0, 0.0), 0.0025, STILL)
    assert specific_force(state) == pytest.approx((0.0, 0.0, 0.0), abs=1e-9)


@pytest.mark.parametrize(("axis", "torque"), [(0, (0.02, 0.0, 0.0)), (1, (0.0, 0.02, 0.0)), (2, (0.0, 0.0, 0.02))])
def test_mixed_torques_turn_the_vehicle_that_way(axis: int, torque: tuple[float, float, float]) -> None:
    """Torque about one axis, at hover lift: the rates grow there by torque over inertia, nowhere else."""
    motors = mix(MASS * GRAVITY, torque)
    assert sum(motors) == pytest.approx(4 * hover())
    state = step(State(position=(0.0, 0.0, -10.0), motors=motors), motors, 0.0025, STILL)
    wanted = [0.0, 0.0, 0.0]
    wanted[axis] = 0.02 / vehicle.INERTIA[axis] * 0.0025
    assert state.rates == pytest.approx(wanted)


def test_a_minute_of_flight() -> None:
    """The quaternion stays unit; the circle, the height and the bank of its speed are kept."""
    flight = Flight(1)
    for number in range(60 * RATE):
        state = flight.tick()
        assert sum(part * part for part in state.q) == pytest.approx(1.0, abs=1e-12)
        if number > 15 * RATE:
            north, east, down = state.position
            assert hypot(north, east) == pytest.approx(RADIUS, abs=2.0)
            assert -down == pytest.approx(HEIGHT, abs=SWING + 1.0)
            assert hypot(*state.velocity[:2]) == pytest.approx(SPEED, abs=2.0)
            assert 15 < degrees(to_euler(state.q)[0]) < 40
    assert 0.8 < flight.state.remaining < 1.0


def test_the_same_seed_is_the_same_flight() -> None:
    """To the last bit, readings included; another seed is another flight."""
    flights = [Flight(7), Flight(7), Flight(8)]
    states = [[flight.tick() for _ in range(3 * RATE)][-1] for flight in flights]
    readings = [flight.sensors.gyro(flight.state) for flight in flights]
    assert (states[0], readings[0]) == (states[1], readings[1])
    assert states[0] != states[2]


def test_rotations_agree() -> None:
    """Angles come back; earth and body undo each other; two directions tell the attitude; the signs are PX4's."""
    q = from_euler(0.3, -0.4, 2.0)
    assert to_euler(q) == pytest.approx((0.3, -0.4, 2.0))
    assert to_body(q, to_earth(q, (1.0, -2.0, 3.0))) == pytest.approx((1.0, -2.0, 3.0))
    for angles in ((0.3, -0.4, 2.0), (3.0, 0.1, -3.0), (0.1, 1.5, 0.0), (-0.2, 0.2, 3.1)):
        q = from_euler(*angles)
        up, field = (0.1, -0.2, -1.0), (0.4, 0.1, 0.8)
        found = aligned((to_body(q, up), to_body(q, field)), (up, field))
        assert angle_between(found, q) == pytest.approx(0.0, abs=1e-6)
    assert to_earth(from_euler(0.0, 0.0, pi / 2), (1.0, 0.0, 0.0)) == pytest.approx((0.0, 1.0, 0.0))
    assert to_earth(from_euler(0.0, 0.3, 0.0), (1.0, 0.0, 0.0))[2] < 0  # pitched up, the nose is higher


def test_sensors_tell_the_truth_on_average() -> None:
    """The gyro but for its bias, the magnetometer's dip, the barometer, a position on the earth."""
    sensors, state = Sensors(Random(3)), State(rates=(0.1, -0.2, 0.3))
    mean = [sum(axis) / 2000 for axis in zip(*(sensors.gyro(state) for _ in range(2000)))]
    assert mean == pytest.approx([a + b for a, b in zip(state.rates, sensors.gyro_bias)], abs=5e-4)
    assert degrees(pressure(0.0)) == pytest.approx(degrees(101_325.0))
    assert sensors.barometer(state) == pytest.approx(pressure(HOME[2]), abs=30.0)
    assert sensors.magnetometer(state)[2] > 0.3  # north of the equator the field points down
    latitude, longitude, altitude = global_position((111_195.0, 111_195.0 * cos(HOME[0] * pi / 180), -12.0))
    assert (latitude - HOME[0], longitude - HOME[1]) == pytest.approx((1.0, 1.0), abs=1e-4)
    assert altitude == HOME[2] + 12.0


class StandIn:
    """A host that only publishes: what `Telemetry` needs of one."""

    def __init__(self) -> None:
        self.broker = uorb.Broker.private()
        self.counts: Counter[tuple[str, int]] = Counter()

    def publish(self, publication: uorb.Publication[Any], message: Any) -> None:
        """Publish and count."""
        publication.publish(message)
        self.counts[publication.topic, publication.instance] += 1


def test_a_second_of_telemetry() -> None:
    """Every topic at its rate, of messages that fit; the sample's time is that of the flight."""
    host, flight = StandIn(), Flight(1)
    with host.broker:
        telemetry = Telemetry(cast(Host, host), flight.sensors)
        for number in range(RATE):
            telemetry.tick(number, flight.tick(), 5_000_000 + number * INTERVAL_US)
        imu = host.broker.subscribe("sensor_combined").copy()
        computer = host.broker.subscribe("onboard_computer_status").copy()
    assert host.counts == {
        ("sensor_combined", 0): 200, ("sensor_accel", 0): 100, ("sensor_accel", 1): 100,
        ("vehicle_attitude", 0): 100, ("vehicle_angular_velocity", 0): 100, ("actuator_motors", 0): 100,
        ("vehicle_local_position", 0): 50, ("sensor_mag", 0): 50, ("sensor_baro", 0): 20,
        ("vehicle_air_data", 0): 20, ("vehicle_global_position", 0): 10, ("sensor_gps", 0): 5,
        ("vehicle_gps_position", 0): 5, ("battery_status", 0): 2, ("vehicle_status", 0): 2,
        ("onboard_computer_status", 0): 1,
    }  # fmt: skip
    assert imu.timestamp == 5_000_000 + 199 * INTERVAL_US
    assert 0 < computer.ram_usage < computer.ram_total


def test_load_from_the_texts_of_proc() -> None:
    """Busy is all but idle and waiting for disks; guest time is counted once; memory in MiB."""
    before = processor_ticks("cpu  100 0 100 700 100 0 0 0 50 0\ncpu0 100 0 100 700 100 0 0 0 50 0\nintr 1\n")
    after = processor_ticks("cpu  150 0 125 1000 125 0 0 0 90 0\ncpu0 150 0 125 1000 125 0 0 0 90 0\nintr 2\n")
    assert [now.load_since(then) for now, then in zip(after, before)] == [19, 19]
    assert before[0].load_since(before[0]) == 0
    assert memory("MemTotal: 2048000 kB\nMemFree: 10 kB\nMemAvailable: 1024000 kB\n") == (1000, 2000)
