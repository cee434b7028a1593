"""What the simulated autopilot publishes: each topic at PX4's rate, from the vehicle's state."""

from collections.abc import Callable
from math import inf, nan
from typing import Any

from .. import msg
from ..broker import Priority
from .host import Host
from .load import Load
from .rotations import yaw_of
from .sensors import HOME, Sensors, global_position, pressure
from .vehicle import CAPACITY, CELLS, State

RATE = 200  # Hz of the fastest topics; all others divide it
INTERVAL_US = 1_000_000 // RATE
#: Seconds that a reader may pause without losing a sample. PX4 keeps one sample of most topics; on a busy
#: desktop a process may wait longer for its turn than a flight computer's thread ever does.
DEPTH = 1.0
DEVICE_IDS = (2_621_448, 3_407_882)  # of the two IMUs, as PX4 packs bus, address and kind
GPS_ID, BARO_ID, MAG_ID = 11_469_061, 6_620_425, 396_825

Entry = tuple[int, Callable[[State, int], None]]


def depth(hz: int) -> int:
    """Return the queue length of a topic."""
    return max(int(hz * DEPTH), 8)


class Telemetry:
    """Publishes a state's messages, each topic when it is due."""

    def __init__(self, host: Host, sensors: Sensors) -> None:
        self._host = host
        self._sensors = sensors
        self._load = Load()
        self._airborne_us = 0
        self._begin_us = 0
        self._publications: dict[str, Any] = {}
        self._accels = [
            host.broker.advertise_multi("sensor_accel", priority=priority, queue_length=depth(100))
            for priority in (Priority.HIGH, Priority.DEFAULT)
        ]
        own = host.broker.advertise_multi("onboard_computer_status", queue_length=depth(1))
        self._publications["onboard_computer_status"] = own
        self._schedule = self._entries()

    def _entries(self) -> list[Entry]:
        every: list[tuple[int, tuple[str, ...], Callable[[State, int], None]]] = [
            (200, ("sensor_combined",), self._imu),
            (100, (), self._accelerometers),
            (100, ("vehicle_attitude", "vehicle_angular_velocity"), self._attitude),
            (100, ("actuator_motors",), self._motors),
            (50, ("vehicle_local_position",), self._local_position),
            (50, ("sensor_mag",), self._magnetometer),
            (20, ("sensor_baro", "vehicle_air_data"), self._air),
            (10, ("vehicle_global_position",), self._global_position),
            (10, (), lambda state, at: self._load.look()),
            (5, ("sensor_gps", "vehicle_gps_position"), self._gps),
            (2, ("battery_status",), self._battery),
            (2, ("vehicle_status",), self._status),
            (1, (), self._computer),
        ]
        for hz, topics, _ in every:
            for topic in topics:
                self._publications[topic] = self._host.broker.advertise(topic, queue_length=depth(hz))
        return [(RATE // hz, publish) for hz, _, publish in every]

    def tick(self, number: int, state: State, sample_us: int) -> None:
        """Publish what is due at tick `number`; `sample_us` is the state's moment on the host's clock."""
        self._begin_us = self._begin_us or sample_us
        if not state.landed and not self._airborne_us:
            self._airborne_us = sample_us
        for every, publish in self._schedule:
            if number % every == 0:
                publish(state, sample_us)

    def _publish(self, topic: str, message: Any) -> None:
        self._host.publish(self._publications[topic], message)

    def _imu(self, state: State, at: int) -> None:
        message = msg.SensorCombined(
            timestamp=at,
            gyro_rad=self._sensors.gyro(state),
            gyro_integral_dt=INTERVAL_US,
            accelerometer_m_s2=self._sensors.accelerometer(state),
            accelerometer_integral_dt=INTERVAL_US,
        )
        self._publish("sensor_combined", message)

    def _accelerometers(self, state: State, at: int) -> None:
        for number, publication in enumerate(self._accels):
            x, y, z = self._sensors.accelerometer(state, number)
            message = msg.SensorAccel(
                timestamp_sample=at, device_id=DEVICE_IDS[number], x=x, y=y, z=z, temperature=41.5, samples=8
            )
            self._host.publish(publication, message)

    def _attitude(self, state: State, at: int) -> None:
        self._publish("vehicle_attitude", msg.VehicleAttitude(timestamp_sample=at, q=state.q))
        rates = msg.VehicleAngularVelocity(timestamp_sample=at, xyz=state.rates)
        self._publish("vehicle_angular_velocity", rates)

    def _motors(self, state: State, at: int) -> None:
        control = (*state.motors, *(nan,) * 8)
        self._publish("actuator_motors", msg.ActuatorMotors(timestamp_sample=at, control=control))

    def _local_position(self, state: State, at: int) -> None:
        (x, y, z), (vx, vy, vz), (ax, ay, az) = state.position, state.velocity, state.acceleration
        message = msg.VehicleLocalPosition(
            timestamp_sample=at,
            xy_valid=True, z_valid=True, v_xy_valid=True, v_z_valid=True, xy_global=True, z_global=True,
            x=x, y=y, z=z, vx=vx, vy=vy, vz=vz, z_deriv=vz, ax=ax, ay=ay, az=az,
            heading=yaw_of(state.q), unaided_heading=yaw_of(state.q), heading_good_for_control=True,
            ref_timestamp=self._begin_us, ref_lat=HOME[0], ref_lon=HOME[1], ref_alt=HOME[2],
            eph=0.1, epv=0.1, evh=0.05, evv=0.05,
            vxy_max=inf, vz_max=inf, hagl_min=inf, hagl_max_z=inf, hagl_max_xy=inf,
        )  # fmt: skip
        self._publish("vehicle_local_position", message)

    def _magnetometer(self, state: State, at: int) -> None:
        x, y, z = self._sensors.magnetometer(state)
        message = msg.SensorMag(timestamp_sample=at, device_id=MAG_ID, x=x, y=y, z=z, temperature=38.0)
        self._publish("sensor_mag", message)

    def _air(self, state: State, at: int) -> None:
        pascal = self._sensors.barometer(state)
        baro = msg.SensorBaro(timestamp_sample=at, device_id=BARO_ID, pressure=pascal, temperature=40.0)
        self._publish("sensor_baro", baro)
        altitude = HOME[2] - state.position[2]
        message = msg.VehicleAirData(
            timestamp_sample=at,
            baro_device_id=BARO_ID,
            baro_alt_meter=altitude + (pressure(altitude) - pascal) / 11.3,  # Pa per metre at this height
            baro_pressure_pa=pascal,
            ambient_temperature=15.0,
            rho=pascal / (287.05 * 288.15),
        )
        self._publish("vehicle_air_data", message)

    def _global_position(self, state: State, at: int) -> None:
        latitude, longitude, altitude = global_position(state.position)
        message = msg.VehicleGlobalPosition(
            timestamp_sample=at, lat=latitude, lon=longitude, alt=altitude, alt_ellipsoid=altitude + 47.0,
            lat_lon_valid=True, alt_valid=True, eph=0.1, epv=0.1, terrain_alt=HOME[2], terrain_alt_valid=True,
        )  # fmt: skip
        self._publish("vehicle_global_position", message)

    def _gps(self, state: State, at: int) -> None:
        fix = self._sensors.gps(state)
        north, east, down = fix.velocity
        message = msg.SensorGps(
            timestamp=at, timestamp_sample=at, device_id=GPS_ID,
            latitude_deg=fix.latitude, longitude_deg=fix.longitude,
            altitude_msl_m=fix.altitude, altitude_ellipsoid_m=fix.altitude + 47.0,
            s_variance_m_s=0.1, c_variance_rad=0.05, fix_type=msg.SensorGps.FIX_TYPE_3D,
            eph=0.6, epv=0.9, hdop=0.6, vdop=0.9,
            vel_m_s=fix.speed, vel_n_m_s=north, vel_e_m_s=east, vel_d_m_s=down, cog_rad=fix.course,
            vel_ned_valid=True, satellites_used=17, heading=nan, heading_offset=nan,
        )  # fmt: skip
        self._publish("sensor_gps", message)
        self._publish("vehicle_gps_position", message)

    def _battery(self, state: State, at: int) -> None:
        cell = state.voltage / CELLS
        message = msg.BatteryStatus(
            connected=True, voltage_v=state.voltage, current_a=state.current, current_average_a=state.current,
            discharged_mah=state.used_mah, remaining=state.remaining, scale=1.0,
            time_remaining_s=state.remaining * CAPACITY * 3.6 / state.current, temperature=nan,
            cell_count=CELLS, capacity=int(CAPACITY), id=1, is_required=True,
            voltage_cell_v=(*(cell,) * CELLS, *(0.0,) * (14 - CELLS)),
        )  # fmt: skip
        self._publish("battery_status", message)

    def _status(self, state: State, at: int) -> None:
        kind = msg.VehicleStatus
        message = kind(
            armed_time=self._begin_us, takeoff_time=self._airborne_us, nav_state_timestamp=self._begin_us,
            arming_state=kind.ARMING_STATE_ARMED, nav_state=kind.NAVIGATION_STATE_AUTO_MISSION,
            nav_state_user_intention=kind.NAVIGATION_STATE_AUTO_MISSION,
            vehicle_type=kind.VEHICLE_TYPE_ROTARY_WING, system_type=2, system_id=1, component_id=1,
            power_input_valid=True, pre_flight_checks_pass=True,
        )  # fmt: skip
        self._publish("vehicle_status", message)

    def _computer(self, state: State, at: int) -> None:
        self._publish("onboard_computer_status", msg.OnboardComputerStatus(**self._load.fields()))
