"""Configuration of truth sources and orbits in a profile, a scenario or on the control channel."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, Final, Literal, Self, TypeAlias, get_args

import numpy as np
from pydantic import BaseModel, Field, PrivateAttr, model_validator

from starhil.emulator.errors import EmulatorError
from starhil.emulator.simulation.config_model import Date, Strict, UserPath
from starhil.emulator.truth.feed import Socket
from starhil.emulator.truth.feed_message import JsonFormat
from starhil.emulator.truth.live import LiveTruth
from starhil.emulator.truth.orbit import LARGEST_ECCENTRICITY, KeplerOrbit, Orbit, OrbitState, TleOrbit
from starhil.emulator.truth.plausibility import doubt_of_orbit
from starhil.emulator.truth.reading_process import read_orbit, read_truth
from starhil.emulator.truth.simulator_42 import Format42
from starhil.emulator.truth.source import (
    MAX_RATE_DEG_S,
    ZERO_RATE,
    FixedTruth,
    RateSegment,
    RateTruth,
    Segment,
    SlewSegment,
    SlewTruth,
    TruthSource,
)
from starid.arithmetic.matrices import dot, length, product
from starid.attitude import Attitude
from starid.attitude.wahba import solve_wahba

AxisRate: TypeAlias = Annotated[float, Field(ge=-MAX_RATE_DEG_S, le=MAX_RATE_DEG_S)]
Rate: TypeAlias = Annotated[list[AxisRate], Field(min_length=3, max_length=3)]
"""Body rate in the sensor frame, degrees per second."""

Turn: TypeAlias = Annotated[float, Field(ge=-360.0, le=360.0)]
"""Right ascension or roll, degrees."""

SegmentSeconds: TypeAlias = Annotated[float, Field(gt=0.0, le=1e9)]


@dataclass(frozen=True)
class InProfileFolder:
    """Marks the key of a file or folder that refers to the folder of the profile that has it."""

    recorded_as: str = ""
    """Name of its copy in a recording; empty: a recording refers to the file itself."""


def profile_paths(model: type[BaseModel]) -> dict[str, InProfileFolder]:
    """Return the dotted keys of a model that are marked so, those of its tables included."""
    paths: dict[str, InProfileFolder] = {}
    for name, field in model.model_fields.items():
        for mark in field.metadata:
            if isinstance(mark, InProfileFolder):
                paths[name] = mark
        for table in models_in(field.annotation):
            paths |= {f"{name}.{key}": mark for key, mark in profile_paths(table).items()}
    return paths


def models_in(annotation: Any) -> list[type[BaseModel]]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    return [model for inner in get_args(annotation) for model in models_in(inner)]


class AttitudeConfig(Strict):
    """An attitude: right ascension, declination and roll in degrees, or a quaternion."""

    ra_deg: Turn | None = None
    """Right ascension of the boresight."""
    dec_deg: Annotated[float, Field(ge=-90.0, le=90.0)] | None = None
    """Declination of the boresight."""
    roll_deg: Turn | None = None
    """Angle by which celestial north is turned counter-clockwise in the image; default: 0."""
    quaternion_xyzw: Annotated[list[float], Field(min_length=4, max_length=4)] | None = None
    """Unit quaternion, ICRS to sensor, scalar last, instead of the angles."""

    @model_validator(mode="after")
    def _one_form(self) -> Self:
        angles = (self.ra_deg, self.dec_deg, self.roll_deg)
        if self.quaternion_xyzw is not None:
            if any(angle is not None for angle in angles):
                raise ValueError("give ra_deg, dec_deg, roll_deg or quaternion_xyzw, not both")
            if abs(length(np.array(self.quaternion_xyzw)) - 1.0) > 0.01:
                raise ValueError("quaternion_xyzw is not of length 1")
        elif self.ra_deg is None or self.dec_deg is None:
            raise ValueError("give ra_deg and dec_deg (roll_deg defaults to 0), or quaternion_xyzw")
        return self

    def build(self) -> Attitude:
        if self.quaternion_xyzw is not None:
            return Attitude(np.array(self.quaternion_xyzw))
        return Attitude.from_radec_roll(self.ra_deg or 0.0, self.dec_deg or 0.0, self.roll_deg or 0.0)


DEFAULT_ATTITUDE = AttitudeConfig(ra_deg=83.8, dec_deg=-1.2, roll_deg=0.0)
"""Orion, which is easy to recognise in an image."""


Angle: TypeAlias = Annotated[float, Field(ge=-360.0, le=360.0)]
Row: TypeAlias = Annotated[list[Annotated[float, Field(ge=-1.0, le=1.0)]], Field(min_length=3, max_length=3)]

ORTHONORMAL: Final = 1e-4
"""Largest error of a mount matrix that is attributed to rounding."""


class MountConfig(Strict):
    """Mount of the sensor: the rotation from the body frame to the sensor frame, in one of three forms."""

    quaternion_xyzw: Annotated[list[float], Field(min_length=4, max_length=4)] | None = None
    """Quaternion body to sensor, scalar last, of length 1; it rotates vectors: v_sensor = q ⊗ v_body ⊗ q*."""
    matrix: Annotated[list[Row], Field(min_length=3, max_length=3)] | None = None
    """The sensor's x, y and z axes in the body frame, as three rows."""
    euler_deg: Annotated[list[Angle], Field(min_length=3, max_length=3)] | None = None
    """Angles of the successive rotations from the body axes to the sensor axes, in the convention of 42."""
    sequence: Annotated[str, Field(pattern="^[123]{3}$")] = "321"
    """Axes of `euler_deg`: 1 is x, 2 is y, 3 is z."""

    @model_validator(mode="after")
    def _one_form(self) -> Self:
        forms = (self.quaternion_xyzw, self.matrix, self.euler_deg)
        if sum(form is not None for form in forms) != 1:
            raise ValueError("give one of quaternion_xyzw, matrix and euler_deg")
        if self.quaternion_xyzw is not None and abs(length(np.array(self.quaternion_xyzw)) - 1.0) > 0.01:
            raise ValueError("quaternion_xyzw is not of length 1")
        if self.matrix is not None:
            axes = np.array(self.matrix)
            if (
                np.abs(product(axes, axes.T) - np.eye(3)).max() > ORTHONORMAL
                or dot(np.cross(axes[0], axes[1]), axes[2]) < 0.0
            ):
                raise ValueError("matrix is not a rotation; its rows must be orthonormal and right-handed")
        if any(one == other for one, other in pairwise(self.sequence)):
            raise ValueError(f"sequence {self.sequence} turns about one axis twice in a row")
        return self

    def build(self) -> Attitude:
        """Return the rotation body→sensor."""
        if self.quaternion_xyzw is not None:
            return Attitude(np.array(self.quaternion_xyzw))
        if self.matrix is not None:
            return solve_wahba(np.array(self.matrix).T, np.eye(3))
        rotation = Attitude.identity()
        for axis, angle in zip(self.sequence, self.euler_deg or (), strict=True):
            turn = np.zeros(3)
            turn[int(axis) - 1] = math.radians(angle)
            rotation = rotation.rotated(turn)
        return rotation


class SourceConfig(Strict):
    """Keys of every truth source."""

    kind: str
    """Selects this truth source."""
    mount: MountConfig | None = None
    """Mount of the sensor on the body; the truth then describes the body."""


class StartConfig(SourceConfig):
    """Keys of a truth source that starts from an attitude."""

    attitude: AttitudeConfig = DEFAULT_ATTITUDE
    """Attitude at the start; of a feed, before the first message."""


class SocketConfig(StartConfig):
    """Keys of a truth source with a socket."""

    stale_s: Annotated[float, Field(gt=0.0, le=3600.0)] = 1.0
    """Silence after which the attitude is held and flagged `stale`."""


class FixedConfig(StartConfig):
    """An attitude that does not change."""

    kind: Literal["fixed"]

    def build(self, now_s: float, folder: Path) -> TruthSource:  # noqa: ARG002 (one signature for all)
        return FixedTruth(self.attitude.build())


class RateConfig(StartConfig):
    """A rotation at a constant body rate, starting from an attitude."""

    kind: Literal["rate"]
    rate_deg_s: Rate
    """Body rate about x, y and z of the sensor frame."""

    def build(self, now_s: float, folder: Path) -> TruthSource:  # noqa: ARG002 (one signature for all)
        """Make the source; the rotation begins now."""
        return RateTruth(self.attitude.build(), np.radians(self.rate_deg_s), start_s=now_s)


class HoldConfig(Strict):
    """Hold the attitude for a time."""

    do: Literal["hold"]
    """Selects this segment."""
    seconds: SegmentSeconds
    """Duration."""

    def build(self) -> Segment:
        return RateSegment(self.seconds, ZERO_RATE)


class TurnConfig(Strict):
    """Rotate at a constant body rate for a time."""

    do: Literal["rate"]
    """Selects this segment."""
    seconds: SegmentSeconds
    """Duration."""
    rate_deg_s: Rate
    """Body rate about x, y and z of the sensor frame."""

    def build(self) -> Segment:
        return RateSegment(self.seconds, np.radians(self.rate_deg_s))


class SlewToConfig(Strict):
    """Slew about one axis to an attitude, from rest to rest."""

    do: Literal["slew"]
    """Selects this segment."""
    to: AttitudeConfig
    """Attitude at the end."""
    max_rate_deg_s: Annotated[float, Field(ge=1e-6, le=100.0)]
    """Maximum body rate."""
    shape: Literal["smooth", "limited"] = "smooth"
    """Rate over time: `smooth` (no jump in acceleration), or `limited` (constant acceleration, constant rate,
    constant deceleration)."""
    acceleration_deg_s2: Annotated[float, Field(ge=1e-6, le=1e6)] = 0.1
    """Acceleration of `limited`."""

    def build(self) -> Segment:
        return SlewSegment(
            self.to.build(),
            math.radians(self.max_rate_deg_s),
            self.shape,
            math.radians(self.acceleration_deg_s2),
        )


MAX_SEGMENTS: Final = 500
"""Most segments of a slew; a longer motion is a file. They fit into one request on the control channel."""

SegmentConfig: TypeAlias = Annotated[HoldConfig | TurnConfig | SlewToConfig, Field(discriminator="do")]


class SlewConfig(StartConfig):
    """A sequence of holds, constant rates and slews."""

    kind: Literal["slew"]
    segments: Annotated[list[SegmentConfig], Field(min_length=1, max_length=MAX_SEGMENTS)]
    """Segments in order."""
    repeat: bool = False
    """Whether to start again after the last segment."""

    def build(self, now_s: float, folder: Path) -> TruthSource:  # noqa: ARG002 (one signature for all)
        """Make the source; the first segment begins now."""
        segments = [segment.build() for segment in self.segments]
        return SlewTruth(self.attitude.build(), segments, start_s=now_s, repeat=self.repeat)


class FileConfig(SourceConfig):
    """A file of attitudes: CSV, CCSDS AEM, STK `.a` or SPICE; a relative path refers to the profile's folder."""

    kind: Literal["file"]
    path: Annotated[UserPath, InProfileFolder(recorded_as="truth_source.csv")]
    """The file; its content says which format it has, see truth-files.md."""
    start: Literal["run", "now"] = "run"
    """Time zero of the file, which is the first useable date of a file with dates: the start of the run, or the time at
    which the truth is set."""
    repeat: bool = False
    """Whether to start again after the last row."""

    def build(self, now_s: float, folder: Path) -> TruthSource:
        start_s = now_s if self.start == "now" else 0.0
        return replace(read_truth(folder / self.path), start_s=start_s, repeat=self.repeat)


class LiveConfig(SocketConfig):
    """A feed of JSON lines in the format of `starhil.emulator.truth.feed_message`."""

    kind: Literal["live"]
    protocol: Literal["udp", "tcp"] = "udp"
    """Transport of the feed; of UDP, lines that come too fast are dropped, the oldest first (2000 per second are not)."""
    host: str = "127.0.0.1"
    """Address to listen on."""
    port: Annotated[int, Field(ge=0, le=65535)] = 0
    """Port to listen on; 0 for a free one, which is given on the ready line."""
    convention: Literal["rotation", "attitude"] = "rotation"
    """Convention of `q`: `rotation` rotates vectors from ICRS to the body, `attitude` is the conjugate, as in
    42, Basilisk and most textbooks."""
    order: Literal["xyzw", "wxyz"] = "xyzw"
    """Position of the scalar in `q`: last or first."""
    timeline: Literal["anchor", "run"] = "anchor"
    """Meaning of `t` in a message: with `anchor`, the first message refers to its time of arrival; with
    `run`, `t` is simulation time in seconds."""
    lockstep: bool = False
    """Whether each message advances the stepped clock to its `t` and is then answered; TCP only."""

    @model_validator(mode="after")
    def _lockstep_needs_tcp(self) -> Self:
        if self.lockstep and self.protocol != "tcp":
            raise ValueError('lockstep needs protocol = "tcp", because each message is answered')
        return self

    @property
    def socket(self) -> Socket:
        return "udp" if self.protocol == "udp" else "listen"

    def build(self, now_s: float, folder: Path) -> TruthSource:  # noqa: ARG002 (one signature for all)
        """Make the source; the emulation opens its socket."""
        return LiveTruth(
            self.attitude.build(),
            stale_s=self.stale_s,
            timeline=self.timeline,
            message_format=JsonFormat(self.convention, self.order),
        )


class Config42(SocketConfig):
    """The simulator 42, over its socket (`Inp_IPC.txt`, mode TX); in lock-step on the stepped clock."""

    kind: Literal["42"]
    role: Literal["client", "server"] = "client"
    """`client` connects to 42 (SERVER in `Inp_IPC.txt`); `server` listens (CLIENT in `Inp_IPC.txt`)."""
    host: str = "127.0.0.1"
    """Address of 42, or address to listen on."""
    port: Annotated[int, Field(ge=0, le=65535)] = 4242
    """Port; 0 to listen on a free one, which is given on the ready line."""
    spacecraft: Annotated[int, Field(ge=0, le=999)] = 0
    """Number of the spacecraft, i of `SC[i]`."""
    orbit: Annotated[int, Field(ge=0, le=999)] = 0
    """Number of the reference orbit, i of `Orb[i]`."""

    @model_validator(mode="after")
    def _port_to_connect_to(self) -> Self:
        if self.role == "client" and self.port == 0:
            raise ValueError('port: 0 needs role = "server"; give the port of 42')
        return self

    @property
    def socket(self) -> Socket:
        return "connect" if self.role == "client" else "listen"

    def build(self, now_s: float, folder: Path) -> TruthSource:  # noqa: ARG002 (one signature for all)
        """Make the source; the emulation opens its socket."""
        return LiveTruth(
            self.attitude.build(),
            stale_s=self.stale_s,
            message_format=Format42(self.spacecraft, self.orbit),
            kind=self.kind,
        )


FeedConfig: TypeAlias = LiveConfig | Config42
"""A truth source with a socket."""

TruthConfig: TypeAlias = Annotated[
    FixedConfig | RateConfig | SlewConfig | FileConfig | LiveConfig | Config42, Field(discriminator="kind")
]


OrbitAngle: TypeAlias = Annotated[float, Field(ge=-360.0, le=360.0)]
Metres: TypeAlias = Annotated[float, Field(ge=-1e9, le=1e9)]
MetresPerSecond: TypeAlias = Annotated[float, Field(ge=-2e4, le=2e4)]


class KeplerConfig(Strict):
    """Keplerian elements, relative to the GCRS equator and equinox."""

    kind: Literal["kepler"]
    """Selects this form of the orbit."""
    semi_major_axis_km: Annotated[float, Field(ge=6378.137, le=1e6)]
    """Semi-major axis; 6878 for an altitude of 500 km."""
    eccentricity: Annotated[float, Field(ge=0.0, le=LARGEST_ECCENTRICITY)] = 0.0
    """Eccentricity."""
    inclination_deg: Annotated[float, Field(ge=0.0, le=180.0)]
    """Inclination to the equator."""
    raan_deg: OrbitAngle = 0.0
    """Right ascension of the ascending node."""
    argument_of_perigee_deg: OrbitAngle = 0.0
    """Argument of perigee."""
    mean_anomaly_deg: OrbitAngle = 0.0
    """Mean anomaly at the date."""
    date: Date | None = None
    """Date of these values; default: the start date of the run."""
    j2: bool = True
    """Whether node and perigee drift at the secular rates due to the Earth's oblateness."""

    def build(self, start_unix_s: float, folder: Path) -> Orbit:  # noqa: ARG002 (one signature for all)
        """Make the orbit for a run that starts at a Unix time."""
        return KeplerOrbit(
            start_unix_s if self.date is None else self.date,
            1e3 * self.semi_major_axis_km,
            self.eccentricity,
            math.radians(self.inclination_deg),
            math.radians(self.raan_deg),
            math.radians(self.argument_of_perigee_deg),
            math.radians(self.mean_anomaly_deg),
            self.j2,
        )


class StateConfig(Strict):
    """Position and velocity at one time, relative to the Earth's centre, GCRS."""

    kind: Literal["state"]
    """Selects this form of the orbit."""
    position_m: Annotated[list[Metres], Field(min_length=3, max_length=3)]
    """Position."""
    velocity_m_s: Annotated[list[MetresPerSecond], Field(min_length=3, max_length=3)]
    """Velocity."""
    date: Date | None = None
    """Date of these values; default: the start date of the run."""
    j2: bool = True
    """Whether node and perigee drift at the secular rates due to the Earth's oblateness."""

    def build(self, start_unix_s: float, folder: Path) -> Orbit:  # noqa: ARG002 (one signature for all)
        """Make the orbit for a run that starts at a Unix time."""
        state = OrbitState(np.array(self.position_m), np.array(self.velocity_m_s))
        doubt = doubt_of_orbit(state)
        if doubt:
            raise EmulatorError(f"orbit: {doubt}")
        return KeplerOrbit.from_state(start_unix_s if self.date is None else self.date, state, j2=self.j2)


class TleConfig(Strict):
    """A two-line element set, propagated by SGP4."""

    kind: Literal["tle"]
    """Selects this form of the orbit."""
    line1: str
    """First line, 69 characters."""
    line2: str
    """Second line, 69 characters."""

    def build(self, start_unix_s: float, folder: Path) -> Orbit:  # noqa: ARG002 (one signature for all)
        """Make the orbit, which must be valid at the start of the run."""
        orbit = TleOrbit(self.line1, self.line2)
        if doubt_of_orbit(orbit.state(start_unix_s)):
            raise EmulatorError(
                "orbit: TLE: is no orbit about the Earth at the run's date; give a current TLE"
            )
        return orbit


class OrbitFileConfig(Strict):
    """A file of positions and velocities with dates: CCSDS OEM or STK `.e`; a relative path refers to the profile's folder."""

    kind: Literal["file"]
    """Selects this form of the orbit."""
    path: Annotated[UserPath, InProfileFolder(recorded_as="orbit_source")]
    """The file, see truth-files.md."""
    _read: Orbit | None = PrivateAttr(None)

    def build(self, start_unix_s: float, folder: Path) -> Orbit:  # noqa: ARG002 (one signature for all)
        """Read the file, the first time: whoever must not wait for that calls it before."""
        if self._read is None:
            self._read = read_orbit(folder / self.path)
        return self._read


OrbitConfig: TypeAlias = Annotated[
    KeplerConfig | StateConfig | TleConfig | OrbitFileConfig, Field(discriminator="kind")
]
