"""The companion's attitude estimator against the simulated truth, and its comparison."""

from math import degrees, radians
from random import Random

import pytest

from uorb_net.demo.autopilot import Flight
from uorb_net.demo.estimator import Comparison, Estimator
from uorb_net.demo.rotations import LEVEL, angle_between, from_euler, yaw_of
from uorb_net.demo.sensors import FIELD, Sensors
from uorb_net.demo.telemetry import RATE
from uorb_net.demo.vehicle import State


def follow(flight: Flight, estimator: Estimator, seconds: float) -> list[float]:
    """Let an estimator follow a flight; return the errors in degrees."""
    errors = []
    for number in range(int(seconds * RATE)):
        state, sensors = flight.tick(), flight.sensors
        if number % 4 == 0:
            estimator.magnetic(sensors.magnetometer(state))
            estimator.velocity(state.time, state.velocity)
        q = estimator.inertial(state.time, sensors.gyro(state), sensors.accelerometer(state))
        if q is not None:
            errors.append(degrees(angle_between(q, state.q)))
    return errors


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_it_follows_a_flight_from_the_ground(seed: int) -> None:
    """Within 3 degrees all the way, banked turns and gyro bias included; without the gyro's it would be lost."""
    errors = follow(Flight(seed), Estimator(FIELD), 40.0)
    assert max(errors) < 3.0
    assert sum(errors) / len(errors) < 1.5


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_it_may_begin_in_a_turn(seed: int) -> None:
    """In a bank of 27 degrees it is near at once, though the accelerometer feels no bank; 10 s later it is right."""
    flight = Flight(seed)
    for _ in range(17 * RATE):
        flight.tick()
    estimator = Estimator(FIELD)
    estimator.velocity(flight.state.time, flight.state.velocity)
    flight.tick()
    errors = follow(flight, estimator, 20.0)
    assert errors[0] < 8.0
    assert max(errors[10 * RATE :]) < 3.0


def test_a_wrong_guess_is_mended() -> None:
    """Begun with a heading alone, it takes a turn for level flight; the tilt is right within a second or two."""
    flight = Flight(1)
    for _ in range(12 * RATE):
        flight.tick()
    estimator = Estimator(FIELD)
    estimator.heading(yaw_of(flight.state.q))
    for _ in range(3 * RATE):
        state = flight.tick()
        estimator.velocity(state.time, state.velocity)
        estimator.inertial(state.time, flight.sensors.gyro(state), flight.sensors.accelerometer(state))
    assert estimator.q is not None
    assert degrees(angle_between(estimator.q, state.q)) < 4.0


def test_it_learns_the_gyro_bias_at_rest() -> None:
    """To a few mrad/s, of a bias ten times that."""
    state, sensors, estimator = State(), Sensors(Random(4)), Estimator(FIELD)
    sensors.gyro_bias = (0.03, -0.02, 0.01)
    for number in range(60 * RATE):
        estimator.magnetic(sensors.magnetometer(state))
        estimator.velocity(number / RATE, state.velocity)
        estimator.inertial(number / RATE, sensors.gyro(state), sensors.accelerometer(state))
    assert estimator.bias == pytest.approx(sensors.gyro_bias, abs=0.004)


def test_without_a_magnetometer_it_takes_a_heading_to_begin_with() -> None:
    """And nothing before."""
    estimator = Estimator()
    assert estimator.inertial(1.0, (0.0, 0.0, 0.0), (0.0, 0.0, -9.81)) is None
    estimator.heading(radians(70))
    q = estimator.inertial(1.01, (0.0, 0.0, 0.0), (0.0, 0.0, -9.81))
    assert q == pytest.approx(from_euler(0.0, 0.0, radians(70)))


def test_a_gap_in_the_data_is_no_rotation() -> None:
    """Time that nobody measured is passed over."""
    estimator = Estimator()
    estimator.heading(0.0)
    estimator.inertial(1.0, (0.0, 0.0, 1.0), (0.0, 0.0, -9.81))
    assert estimator.inertial(9.0, (0.0, 0.0, 1.0), (0.0, 0.0, -9.81)) == LEVEL


def test_attitudes_are_compared_at_the_same_moment() -> None:
    """Whichever arrives first; too far apart in time they are not compared; the first seconds do not count."""
    comparison = Comparison()
    turned = from_euler(0.0, 0.0, radians(5))
    comparison.own(1.0, LEVEL)
    comparison.vehicle(1.002, turned)  # waits for an estimate that is as new
    before = comparison.latest
    comparison.own(1.005, LEVEL)
    assert (before, comparison.latest) == (None, (turned, LEVEL))
    assert comparison.count == 0
    comparison.own(4.0, LEVEL)
    comparison.vehicle(3.5, turned)
    comparison.vehicle(4.0, turned)
    assert comparison.count == 1
    assert (comparison.mean, comparison.worst) == pytest.approx((5.0, 5.0))
