"""Device profiles: TOML files that configure camera, sensor, truth, links and parameters of a run.

A profile may extend another (`extends = "ideal"`, or a path relative to the file) and override its keys. Every key
is validated; an error names the file, the key and the remedy.
"""

from __future__ import annotations

import math
import tomllib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from itertools import permutations, product
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal, Self

from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    PrivateAttr,
    ValidationError,
    field_validator,
    model_validator,
)

from starhil.emulator.errors import EmulatorError
from starhil.emulator.toml_file import find_toml, read_toml
from starhil.emulator.truth.config import (
    Date,
    FixedConfig,
    OrbitConfig,
    Strict,
    TruthConfig,
    UserPath,
)
from starhil.protocol.errors import ProtocolError
from starhil.protocol.icd import load_unit
from starhil.protocol.names import DEFAULT_UNIT, bundled_units, find, not_found, remedy
from starhil.protocol.validation_messages import problems
from starhil.protocol.values import IcdError
from starid.earth import unix_time

if TYPE_CHECKING:
    from starhil.protocol.values import Parameter
    from starid.camera import Camera

DEFAULT_PROFILE: Final = "cubestar"
MAX_EXTENDS_DEPTH: Final = 8

FrameSeconds = Annotated[float, Field(ge=0.0, le=10.0)]
"""Duration of one stage of a frame, seconds."""

Milliamperes = Annotated[float, Field(ge=0.0, le=10_000.0)]
_J2000_UNIX_S: Final = 946_728_000.0
_JULIAN_YEAR_S: Final = 365.25 * 86_400.0

ParticleRate = Annotated[float, Field(ge=0.0, le=1e6)]
FocalLength = Annotated[float, Field(ge=1.0, le=1e6)]
PixelPosition = Annotated[float, Field(ge=-1e4, le=1e4)]
DistortionTerm = Annotated[float, Field(ge=-1e6, le=1e6)]
OfCamera = Field(min_length=9, max_length=9)
"""One item for each of fx, fy, cx, cy (pixels), k1, k2, p1, p2, k3."""


class RunConfig(Strict):
    """Seed, clock, algorithm and saved state of a run."""

    seed: Annotated[int, Field(ge=0, le=2**63 - 1)] = 1
    """Seed of all noise and faults; on the stepped clock, the same seed, profile and commands give the same
    bytes."""
    clock: str = "real"
    """`real`, `scaled:FACTOR` or `stepped` (advances only by `step` on the control channel)."""
    algorithm: Literal["geometric", "lsi", "rsi"] = "geometric"
    """Star identification algorithm: `geometric`, or one of the thesis (`lsi`, `rsi`)."""
    worker: Literal["process", "thread", "error_model"] = "process"
    """Whether frames are rendered and solved in a worker process or in a thread of the emulator, or replaced by an
    error model: attitudes are the truth with noise, and there are no images of the sky."""
    state_dir: UserPath = ""
    """Folder for state that survives a restart: saved parameters, boot count, CANopen settings. Empty: no
    state is kept."""
    start_unix_s: Date = 1_767_225_600.0
    """Device clock at the start of the run, until it is set: a date, or Unix time; default: 2026-01-01."""


class CatalogConfig(Strict):
    """The star catalogue."""

    path: UserPath = ""
    """Hipparcos file; empty: the installed catalogue."""
    epoch: Annotated[float, Field(ge=1900.0, le=2200.0)] | None = None
    """Julian year of the star positions; default: that of the date at the start of the run, to a tenth."""


class CameraConfig(Strict):
    """The optics and pixel array."""

    width: Annotated[int, Field(ge=64, le=4096)] = 937
    """Columns of the pixel array."""
    height: Annotated[int, Field(ge=64, le=4096)] = 937
    """Rows of the pixel array."""
    fov_deg: Annotated[float, Field(ge=1.0, le=120.0)] | None = None
    """Field of view along a row, edge to edge; 42 if neither this nor `focal_px` is given."""
    focal_px: Annotated[list[FocalLength], Field(min_length=2, max_length=2)] | None = None
    """Focal length along x and y, instead of `fov_deg`."""
    centre_px: Annotated[list[PixelPosition], Field(min_length=2, max_length=2)] | None = None
    """Position of the optical axis on the pixel array; default: the centre."""
    model: Literal["pinhole", "equidistant", "flat"] = "pinhole"
    """Projection of the lens."""
    distortion: list[DistortionTerm] = Field(default_factory=list, max_length=5)
    """Brown–Conrady coefficients k1, k2, p1, p2, k3."""

    def values(self) -> dict[str, Any]:
        """Return the keys that `starid.camera.Camera.from_dict` reads."""
        values = self.model_dump(exclude_none=True)
        if "focal_px" not in values:
            values.setdefault("fov_deg", 42.0)
        return values


class DeviceConfig(Strict):
    """Identification, boot time and rate estimation of the unit."""

    node_type: Annotated[int, Field(ge=0, le=255)] = 0x53
    """Reported in `identification` (128)."""
    interface_version: Annotated[int, Field(ge=0, le=255)] = 1
    """Reported in `identification` (128)."""
    firmware_major: Annotated[int, Field(ge=0, le=255)] = 1
    """Reported in `identification` (128)."""
    firmware_minor: Annotated[int, Field(ge=0, le=255)] = 0
    """Reported in `identification` (128)."""
    boot_s: Annotated[float, Field(ge=0.0, le=600.0)] = 0.5
    """Time in boot mode after a start or reset, in simulation time."""
    rate_window: Annotated[int, Field(ge=2, le=20)] = 2
    """Number of valid frames from which the body rate is estimated, if the star identifier does not do so."""
    dark_frames: Annotated[int, Field(ge=0, le=100)] = 0
    """Number of frames averaged into the dark frame that the unit subtracts from each image; 0: none."""


class CalibrationConfig(BaseModel):
    """Errors of the camera's parameters as known from its calibration; other keys are notes by `starid calibrate`."""

    model_config = ConfigDict(extra="allow", frozen=True)

    sigma: Annotated[list[Annotated[float, Field(ge=0.0, le=1e4)]], OfCamera] | None = None
    """Standard deviations of fx, fy, cx, cy (pixels), k1, k2, p1, p2, k3. They are independent, but fx and fy have
    the same relative error."""
    covariance: (
        Annotated[list[Annotated[list[Annotated[float, Field(ge=-1e8, le=1e8)]], OfCamera]], OfCamera] | None
    ) = None
    """Covariance of the same parameters; if it is given, `sigma` is not used."""

    @field_validator("covariance")
    @classmethod
    def _check_covariance(cls, rows: list[list[float]] | None) -> list[list[float]] | None:
        if rows is None:
            return None
        for i, j in product(range(9), repeat=2):
            possible = (
                min(rows[i][i], rows[j][j]) >= 0.0 and rows[i][j] ** 2 <= 1.000001 * rows[i][i] * rows[j][j]
            )
            if not possible or not math.isclose(rows[i][j], rows[j][i], rel_tol=1e-6):
                raise ValueError(f"row {i + 1}, column {j + 1} is not that of a covariance matrix")
        return rows

    def matrix(self) -> list[list[float]] | None:
        """Return the covariance; None if no errors are known."""
        if self.covariance is not None or self.sigma is None:
            return self.covariance
        rows = [
            [sigma**2 if row == column else 0.0 for column in range(9)]
            for row, sigma in enumerate(self.sigma)
        ]
        rows[0][1] = rows[1][0] = self.sigma[0] * self.sigma[1]
        return rows


class PowerConfig(Strict):
    """Current of the unit in each phase of a frame; the defaults are published for the first CubeStar."""

    voltage_v: Annotated[float, Field(ge=0.1, le=100.0)] = 3.3
    """Supply voltage."""
    idle_ma: Milliamperes = 71.0
    """Current while idle, and in modes without frames."""
    imager_on_ma: Milliamperes = 121.0
    """Current between switching on the imager and the exposure."""
    exposure_ma: Milliamperes = 177.0
    """Current during exposure, read-out and processing."""
    transfer_ma: Milliamperes = 82.0
    """Current while the result is transferred."""
    imager_on_s: FrameSeconds = 0.068
    """Time from switching on the imager to the exposure."""
    transfer_s: FrameSeconds = 0.404
    """Duration of the transfer."""


class ThermalConfig(Strict):
    """Temperature of the unit: the mounting's temperature plus heating by the unit's power."""

    mounting_c: Annotated[float, Field(ge=-100.0, le=150.0)] = 20.0
    """Mean temperature of the mounting, degrees Celsius."""
    swing_c: Annotated[float, Field(ge=0.0, le=100.0)] = 0.0
    """Amplitude of its variation over an orbit, degrees."""
    period_s: Annotated[float, Field(ge=1.0, le=1e6)] = 5700.0
    """Period of that variation."""
    heating_c_w: Annotated[float, Field(ge=0.0, le=1000.0)] = 0.0
    """Steady-state temperature rise of detector and lens above the mounting per watt of mean power."""
    time_constant_s: Annotated[float, Field(ge=0.1, le=1e6)] = 600.0
    """Time constant of that rise."""


class RadiationConfig(Strict):
    """Energetic particles that hit the detector, in addition to `sky.cosmic_rays_s`."""

    quiet_s: ParticleRate = 0.0
    """Particles per second outside the South Atlantic Anomaly."""
    anomaly_s: ParticleRate = 0.0
    """Additional particles per second in the centre of the anomaly at an altitude of 500 km; needs a truth
    with a position."""


class ImagesConfig(Strict):
    """Source of images instead of rendering; `[camera]` then describes the camera of the images."""

    folder: UserPath = ""
    """Folder of PNG, TIFF, JPEG or BMP images, used in the order of their names; relative to the profile."""
    capture: Annotated[int, Field(ge=0, le=99)] | str = ""
    """Number of a camera (0 is the first), or a video file, as in OpenCV's `VideoCapture`."""
    repeat: bool = True
    """Whether to start again after the last image in the folder."""
    dark: UserPath = ""
    """Dark image of the same camera and exposure, which is subtracted from each image."""

    @model_validator(mode="after")
    def _one_source(self) -> Self:
        if self.folder and self.capture != "":
            raise ValueError("folder and capture exclude each other; give one of them")
        return self

    @property
    def used(self) -> bool:
        """Whether images are taken from a folder or a camera."""
        return bool(self.folder) or self.capture != ""

    def resolved(self, relative_to: Path) -> dict[str, Any]:
        """Return the keys, with paths relative to a folder resolved."""
        files = {
            key: str(relative_to / value)
            for key, value in (("folder", self.folder), ("dark", self.dark))
            if value
        }
        return {**self.model_dump(), "capture": str(self.capture), **files}


class TimingConfig(Strict):
    """Processing times of the emulated unit, which are reported in telemetry and delay the results."""

    readout_s: FrameSeconds = 0.020
    """Read-out of the detector."""
    detect_s: FrameSeconds = 0.040
    """Detection, fixed part."""
    detect_per_star_s: Annotated[float, Field(ge=0.0, le=0.01)] = 0.00005
    """Detection, in addition for each star."""
    identify_lost_s: FrameSeconds = 0.020
    """Identification, lost in space."""
    identify_tracking_s: FrameSeconds = 0.010
    """Identification, tracking."""


class SerialConfig(Strict):
    """The serial link."""

    port: str = "auto"
    """`auto` (a pty), a device path, `listen://HOST:PORT`, or `off`."""
    dialect: Literal["a", "b", "c"] = "b"
    """Format of replies: `a` for a CubeComputer, `b` for a stand-alone node, `c` for generation 2."""
    baud: Annotated[int, Field(ge=1200, le=4_000_000)] = 115_200
    """Bit rate."""
    pace: bool = True
    """Whether a message arrives, whole, only at the time at which its last byte would at the bit rate."""
    symlink: UserPath = ""
    """Path of a symbolic link to the pty, created at the start and removed at the end."""


class CanConfig(Strict):
    """The CAN link."""

    channel: str = "auto"
    """`auto` (vcan0 if available, else the TCP hub; a new hub if another emulator there has the address), a python-can channel, or `off`."""
    address: Annotated[int, Field(ge=1, le=254)] = 4
    """CAN address of the device."""
    host_address: Annotated[int, Field(ge=1, le=254)] = 1
    """CAN address of the OBC."""
    frame_gap_s: Annotated[float, Field(ge=0.0, le=1.0)] = 0.0
    """Minimum time between two CAN frames of one message."""


class CanopenConfig(Strict):
    """The CANopen slave, on the channel of the CAN link."""

    node: Annotated[int, Field(ge=0, le=127)] = 0
    """Node ID; 0: off."""


class LinksConfig(Strict):
    """The links to the OBC."""

    serial: SerialConfig = SerialConfig()
    """The serial line."""
    can: CanConfig = CanConfig()
    """The CAN bus."""
    canopen: CanopenConfig = CanopenConfig()
    """The CANopen node on the CAN bus."""


Layer = tuple[str, Mapping[str, Any]]
"""A source of keys, a profile's file or an option `--set`, and its tables."""


class Profile(Strict):
    """A device profile."""

    name: str = "ideal"
    """Name in messages and on the control channel."""
    unit: UserPath = DEFAULT_UNIT
    """Interface definition: name of a bundled unit, or a folder relative to the profile."""
    run: RunConfig = RunConfig()
    """Seed, clock, algorithm, files."""
    catalog: CatalogConfig = CatalogConfig()
    """Stars."""
    camera: CameraConfig = CameraConfig()
    """Optics and pixel array."""
    sensor: dict[str, Any] = Field(default_factory=dict)
    """Fields of `starhil.emulator.sensor.model.SensorModel`, except those that are device parameters."""
    sky: dict[str, Any] = Field(default_factory=dict)
    """Date and bodies (`starhil.emulator.sky.view.Sky`), and fields of
    `starhil.emulator.sky.objects.SkyObjects`."""
    identifier: dict[str, Any] = Field(default_factory=dict)
    """Options of the star identification algorithm."""
    truth: TruthConfig = FixedConfig(kind="fixed")
    """True attitude of the sensor."""
    orbit: OrbitConfig | None = None
    """True orbit of the spacecraft. Without it, the sensor is at the Earth's centre and does not see it."""
    images: ImagesConfig = ImagesConfig()
    """Images from a folder or a camera."""
    device: DeviceConfig = DeviceConfig()
    """Identification and boot."""
    timing: TimingConfig = TimingConfig()
    """Modelled processing times."""
    power: PowerConfig = PowerConfig()
    """Currents by phase."""
    thermal: ThermalConfig = ThermalConfig()
    """Temperature."""
    radiation: RadiationConfig = RadiationConfig()
    """Particles along the orbit."""
    links: LinksConfig = LinksConfig()
    """Serial line, CAN and CANopen."""
    calibration: CalibrationConfig = CalibrationConfig()
    """Known errors of the calibrated camera, as `starid calibrate` writes them. They increase the uncertainty that the
    unit states, and change nothing else. Other keys are notes."""
    health: dict[str, float] = Field(default_factory=dict)
    """Numbers reported as the quantities `health.NAME`, such as temperatures, in the unit of the field.
    Default: in °C, V, A or W what `[thermal]` and `[power]` give, otherwise 0."""
    parameters: dict[str, Any] = Field(default_factory=dict)
    """Defaults of device parameters, named as in the interface definition."""

    _source: Path | None = PrivateAttr(default=None)
    _layers: tuple[Layer, ...] = PrivateAttr(default=())

    @field_validator("sky")
    @classmethod
    def _check_date(cls, sky: dict[str, Any]) -> dict[str, Any]:
        try:
            return {**sky, "date": unix_time(sky["date"])} if "date" in sky else sky
        except ValueError as error:
            raise ValueError(f"date: {error}") from None

    @model_validator(mode="after")
    def _some_use_of_images(self) -> Self:
        if self.images.used and self.run.worker == "error_model":
            raise ValueError('images: run.worker = "error_model" uses no images; choose process or thread')
        return self

    @property
    def start_unix_s(self) -> float:
        """Date of the sky, the orbit and the bodies at the start of the run, as Unix time."""
        return float(self.sky.get("date", self.run.start_unix_s))

    @property
    def epoch(self) -> float:
        """Julian year of the star positions."""
        if self.catalog.epoch is not None:
            return self.catalog.epoch
        return round(2000.0 + (self.start_unix_s - _J2000_UNIX_S) / _JULIAN_YEAR_S, 1)

    def read_from(self, path: Path, layers: Sequence[Layer] = ()) -> Self:
        """Note the file of the profile, to whose folder its relative paths refer, and all its layers; return the profile."""
        self._source = path
        self._layers = tuple(layers)
        return self

    def source_of(self, error: object) -> str:
        """Return the source of the key with which an error begins: an option `--set`, or a file."""
        location = str(error).partition(": ")[0].split(".")
        return _source_of(self._layers, location) or f"profile {self.source}"

    @property
    def source(self) -> str:
        """File of the profile, or its name if there is none, for messages."""
        return self.name if self._source is None else str(self._source)

    @property
    def unit_source(self) -> str:
        """The unit for `load_unit`: name of a bundled unit, or a folder relative to the profile."""
        if self.unit in bundled_units():
            return self.unit
        return str(self.folder / self.unit)

    @property
    def folder(self) -> Path:
        """Folder of the profile, to which its relative paths refer."""
        return Path() if self._source is None else self._source.parent


ALTERNATIVES: Final = (
    (frozenset({"fov_deg"}), frozenset({"focal_px", "centre_px"})),
    (frozenset({"ra_deg", "dec_deg", "roll_deg"}), frozenset({"quaternion_xyzw"})),
    (frozenset({"quaternion_xyzw"}), frozenset({"matrix"}), frozenset({"euler_deg", "sequence"})),
)
"""Sets of keys that exclude each other in a table: field of view, attitude, mount."""

CALIBRATION: Final = frozenset({"focal_length", "centroid_x", "centroid_y", "k1", "k2", "p1", "p2"})
"""Device parameters that describe the camera; by default, the device is calibrated exactly."""

OF_CAMERA: Final = CALIBRATION | {"limiting_magnitude"}
"""Device parameters that are not inherited by a profile with another camera."""

PATHS: Final = frozenset(
    {"truth.path", "orbit.path", "catalog.path", "images.folder", "images.dark", "run.state_dir"}
)
"""Keys of files and folders, which refer to the folder of the profile that has them."""

LINK_PARAMETERS: Final[dict[str, str]] = {
    "serial_dialect": "links.serial.dialect",
    "serial_baud": "links.serial.baud",
    "can_address": "links.can.address",
    "host_address": "links.can.host_address",
    "canopen_node": "links.canopen.node",
}
"""Device parameters whose defaults are set under another key of a profile."""


_A_FAULT: Final = "; this is a fault, which belongs in a scenario (--scenario) or on the control channel"
OF_FAULTS: Final = dict.fromkeys(
    ("fault", "faults", "optical", "serial", "can", "stuck", "error", "reset", "upset", "drop", "corrupt", "junk",
     "delay_s", "split", "gap_s"),
    _A_FAULT,
)  # fmt: skip
"""Keys of faults, which a profile does not have, and the hint for whoever writes one there."""


def load_profile(name_or_path: str = DEFAULT_PROFILE, overrides: Sequence[str] = ()) -> Profile:
    """Read a profile and the profiles it extends, and apply `section.key=value` overrides.

    Raises EmulatorError: each problem names file or option, key and remedy.
    """
    path = find_toml("profile", name_or_path)
    layers = _read_extended(path, 0)
    values: dict[str, Any] = {}
    for _, table in layers:
        if "camera" in table:
            _drop_parameters_of_camera(values)
        values = merge(values, table)
    if any(override.startswith("camera.") for override in overrides):
        _drop_parameters_of_camera(values)
    layers += [_apply_override(values, override) for override in overrides]
    found: list[tuple[Sequence[object], str]] = []
    profile = None
    try:
        profile = Profile.model_validate(values)
    except ValidationError as error:
        listed = problems(error, Profile, values, also=("extends",), hints=OF_FAULTS)
        found += [(problem.location, str(problem)) for problem in listed]
    name = str(values.get("unit", DEFAULT_UNIT))
    unit = _path_of_unit(name, path.parent)
    if unit is None:
        found.append((("unit",), f"unit: {not_found('unit', name)}"))
    for section, check in _checks(values, unit):
        found += _problems_of_keys(section, values.get(section), check)
    if found or profile is None:
        named = ((_source_of(layers, location) or f"profile {path}", text) for location, text in found)
        raise EmulatorError(*(f"{source}: {text}" for source, text in named))
    return profile.read_from(path, layers)


def _checks(
    values: Mapping[str, Any], unit: Path | None
) -> Iterator[tuple[str, Callable[[dict[str, Any]], object]]]:
    """Yield the sections whose keys are those of another class or of the unit at a path, each with a check of its table."""
    run, sky = values.get("run"), values.get("sky")
    if "sensor" in values:
        from starhil.emulator.sensor.model import SensorModel

        yield "sensor", lambda table: SensorModel().with_(**table)
    if isinstance(sky, dict):
        from starhil.emulator.sky.view import Sky

        whole = {key: sky[key] for key in ("date", "bodies") if key in sky}
        yield "sky", lambda table: Sky({**whole, **table})
    if "identifier" in values:
        from starhil.emulator.pipeline.star_identifiers import check_options
        from starid.interface import ALGORITHMS

        algorithm = run.get("algorithm", "geometric") if isinstance(run, dict) else "geometric"
        if algorithm in ALGORITHMS:
            yield "identifier", lambda table: check_options(algorithm, table)
    if "parameters" in values and unit is not None:
        try:
            known = load_unit(unit).device_parameters
        except IcdError:
            return  # reported when the unit is loaded
        yield "parameters", lambda table: _check_parameters(known, table)


def _path_of_unit(name: str, folder: Path) -> Path | None:
    path = folder / find("unit", name)
    try:
        return path if path.exists() else None
    except OSError:  # too long a name, for example
        return None


def _problems_of_keys(
    section: str, table: object, check: Callable[[dict[str, Any]], object]
) -> Iterator[tuple[Sequence[object], str]]:
    """Yield location and text of the problems of a table, each key of which is checked alone."""
    for key, value in table.items() if isinstance(table, dict) else ():
        try:
            check({key: value})
        except (EmulatorError, ProtocolError) as error:
            yield from (((section, key), text) for text in error.problems)


def _check_parameters(known: Mapping[str, Parameter], table: Mapping[str, Any]) -> None:
    for name, value in table.items():
        if name in LINK_PARAMETERS:
            raise EmulatorError(f"parameters.{name}: set {LINK_PARAMETERS[name]} instead")
        if name not in known:
            raise EmulatorError(f"parameters.{name}: unknown key{remedy(name, known)}")
        try:
            known[name].check(value)
        except ProtocolError as error:
            raise EmulatorError(f"parameters.{error}") from None


def camera_of(name_or_path: str) -> Camera:
    """Return the camera of a profile (entry point `starid.cameras`, for `starid identify --profile`).

    Raises StaridError, the only error of which `starid` makes one line, where `load_profile` raises its own.
    """
    from starid.camera import Camera
    from starid.errors import StaridError

    try:
        profile = load_profile(name_or_path)
    except EmulatorError as error:
        raise StaridError(str(error)) from None
    return Camera.from_dict(profile.camera.values())


def _source_of(layers: Sequence[Layer], location: Sequence[object]) -> str:
    """Return the last source that has the key at a location, or else the table that would hold it; empty if none has."""
    for length in range(len(location), 0, -1):
        for source, values in reversed(layers):
            here: Any = values
            for key in location[:length]:
                try:
                    here = here[key]
                except (KeyError, IndexError, TypeError):
                    break
            else:
                return source
    return ""


def _read_extended(path: Path, depth: int) -> list[Layer]:
    """Return the files of a profile and of those that it extends, the profile's last."""
    values = read_toml(path, "profile")
    base = values.pop("extends", None)
    if base is None:
        return [(f"profile {path}", values)]
    if not isinstance(base, str):
        raise EmulatorError(f"profile {path}: extends: must be a name or a path, in quotes")
    if depth >= MAX_EXTENDS_DEPTH:
        raise EmulatorError(
            f"profile {path}: extends: more than {MAX_EXTENDS_DEPTH} deep; does a profile extend itself?"
        )
    try:
        extended = find_toml("profile", base, path.parent)
    except EmulatorError as error:
        raise EmulatorError(f"profile {path}: extends: {error}") from None
    return [*_read_extended(extended, depth + 1), (f"profile {path}", values)]


def _drop_parameters_of_camera(values: dict[str, Any]) -> None:
    """Remove what the device knows of a camera that is going to be replaced: its parameters and their errors."""
    values.pop("calibration", None)
    parameters = values.get("parameters")
    if isinstance(parameters, dict):
        values["parameters"] = {key: value for key, value in parameters.items() if key not in OF_CAMERA}


def _replaced_by(given: Iterable[str]) -> set[str]:
    """Return the keys of a table that are excluded by the given ones."""
    return {
        key
        for forms in ALTERNATIVES
        for keys, by in permutations(forms, 2)
        if not by.isdisjoint(given)
        for key in keys
    }


def merge(base: dict[str, Any], over: Mapping[str, Any]) -> dict[str, Any]:
    """Merge `over` into `base`, table by table.

    A table with another `kind` replaces the whole table, and keys in `over` remove their alternatives from
    `base` (field of view or focal lengths, angles or quaternion, the forms of a mount).
    """
    if "kind" in over and over["kind"] != base.get("kind"):
        return dict(over)
    dropped = _replaced_by(over)
    merged = {key: value for key, value in base.items() if key not in dropped}
    for key, value in over.items():
        below = merged.get(key)
        if isinstance(below, dict) and isinstance(value, Mapping):
            merged[key] = merge(below, value)
        else:
            merged[key] = value
    return merged


def _apply_override(values: dict[str, Any], override: str) -> Layer:
    """Apply one `section.key=value`, and return it as a layer; a value that is not TOML is text."""
    key, equals, text = override.partition("=")
    names = [name.strip() for name in key.split(".")]
    if not equals or not all(names):
        raise EmulatorError(f"--set {override}: write section.key=value, e.g. parameters.update_rate=5")
    try:
        value = tomllib.loads(f"value = {text}")["value"]
    except (tomllib.TOMLDecodeError, RecursionError):
        value = text
    table = values
    for name in names[:-1]:
        below = table.setdefault(name, {})
        if not isinstance(below, dict):
            raise EmulatorError(f"--set {override}: {name} is a value, not a section")
        table = below
    if ".".join(names) in PATHS and isinstance(value, str) and value and not value.startswith("~"):
        value = str(Path(value).absolute())  # relative to the working directory, as on any command line
    if names[-1] == "kind":
        value = text.strip().strip("\"'")  # a name, even if it is a number: 42
    if names[-1] == "kind" and table.get("kind") != value:
        for other in set(table) - ({"attitude"} if value != "file" else set()):
            del table[other]
    for excluded in _replaced_by(names[-1:]) & table.keys():
        del table[excluded]
    table[names[-1]] = value
    layer: Any = value
    for name in reversed(names):
        layer = {name: layer}
    return f"--set {override}", layer
