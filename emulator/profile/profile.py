"""Device profiles: TOML files that configure camera, sensor, truth, links and parameters of a run.

A profile may extend another (`extends = "ideal"`, or a path relative to the file) and override its keys. Every key
is validated; an error names the file, the key and the remedy.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import permutations
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final, Self

from pydantic import (
    Field,
    PrivateAttr,
    ValidationError,
    model_validator,
)

from starhil.emulator.errors import EmulatorError
from starhil.emulator.profile.sections import (
    CalibrationConfig,
    CameraConfig,
    CatalogConfig,
    ClockConfig,
    DeviceConfig,
    ImagesConfig,
    LinksConfig,
    PowerConfig,
    RadiationConfig,
    RunConfig,
    ThermalConfig,
    TimingConfig,
)
from starhil.emulator.profile.toml_file import find_toml, read_toml
from starhil.emulator.sensor.model import SensorModel
from starhil.emulator.sensor.sky.tables import SKY
from starhil.emulator.simulation.config_model import Strict, UserPath, plain_model
from starhil.emulator.truth.config import (
    Config42,
    FileConfig,
    FixedConfig,
    LiveConfig,
    OrbitConfig,
    TruthConfig,
    profile_paths,
)
from starhil.protocol.errors import MAX_PROBLEMS, IcdError, ProtocolError, remedy
from starhil.protocol.files.bundled import DEFAULT_UNIT, bundled, bundled_units, find, not_found
from starhil.protocol.files.user_file import TomlError, parse_toml
from starhil.protocol.files.validation import Problem, TableOf, problems
from starhil.protocol.unit import load_unit
from starid.errors import StaridError
from starid.identification.options import ALGORITHMS

if TYPE_CHECKING:
    from starhil.protocol.icd.values import Parameter
    from starid.camera import Camera

DEFAULT_PROFILE: Final = "cubestar"
MAX_EXTENDS_DEPTH: Final = 8

_J2000_UNIX_S: Final = 946_728_000.0
_JULIAN_YEAR_S: Final = 365.25 * 86_400.0

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
    sensor: Annotated[dict[str, Any], TableOf(plain_model(SensorModel))] = Field(default_factory=dict)
    """Fields of `starhil.emulator.sensor.model.SensorModel`, except those that are device parameters."""
    sky: Annotated[dict[str, Any], TableOf(SKY)] = Field(default_factory=dict)
    """Date and bodies (`starhil.emulator.sensor.sky.view.Sky`), and fields of
    `starhil.emulator.sensor.sky.objects.SkyObjects`."""
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
    clock: ClockConfig = ClockConfig()
    """Errors of the clock and of the latency."""
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

    @model_validator(mode="after")
    def _some_use_of_images(self) -> Self:
        if self.images.used and self.run.worker == "error_model":
            raise ValueError('images: run.worker = "error_model" uses no images; choose process or thread')
        return self

    @model_validator(mode="after")
    def _orbit_of_satellites(self) -> Self:
        carries_orbit = isinstance(self.truth, FileConfig | LiveConfig | Config42)
        if self.sky.get("satellites") is not None and self.orbit is None and not carries_orbit:
            raise ValueError("sky.satellites: they are seen from an orbit; give one, such as orbit=leo")
        return self

    @model_validator(mode="after")
    def _pixels_of_focal_length(self) -> Self:
        if self.camera.focal_mm is not None and "pixel_um" not in self.sensor:
            raise ValueError("camera.focal_mm: needs the width of a pixel: give sensor.pixel_um")
        return self

    @property
    def camera_values(self) -> dict[str, Any]:
        """Keys that `starid.camera.Camera.from_dict` reads."""
        return self.camera.values(float(self.sensor.get("pixel_um", SensorModel.pixel_um)))

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

    def with_overrides(self, overrides: Sequence[str]) -> Profile:
        """Return the profile with `section.key=value` overrides, as `load_profile` applies them."""
        path = Path(self.name) if self._source is None else self._source
        return _overridden(path, self.model_dump(exclude_unset=True), [], overrides)

    def source_of(self, error: object) -> str:
        """Return the source of the key with which an error begins: an option `--set`, or a file."""
        location = str(error).partition(": ")[0].split(".")
        return _source_of(self._layers, location) or f"profile {self.source}"

    @property
    def source(self) -> str:
        """File of the profile, or its name if there is none, for messages."""
        return self.name if self._source is None else str(self._source)

    @property
    def name_or_path(self) -> str:
        """What loads the profile again: name of a bundled profile, or path of a file."""
        path = self._source
        return path.stem if path is not None and bundled("profile").get(path.stem) == path else self.source

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
    (frozenset({"fov_deg"}), frozenset({"focal_mm"}), frozenset({"focal_px"})),
    (frozenset({"ra_deg", "dec_deg", "roll_deg"}), frozenset({"quaternion_xyzw"})),
    (frozenset({"quaternion_xyzw"}), frozenset({"matrix"}), frozenset({"euler_deg", "sequence"})),
)
"""Sets of keys that exclude each other in a table: field of view, attitude, mount."""

CALIBRATION: Final = frozenset({"focal_length", "centroid_x", "centroid_y", "k1", "k2", "p1", "p2"})
"""Device parameters that describe the camera; by default, the device is calibrated exactly."""

CAMERA_PARAMETERS: Final = CALIBRATION | {"limiting_magnitude"}
"""Device parameters that are not inherited by a profile with another camera."""

DEVICE_OPTIONS: Final = {
    "largest_error_deg": "; the device has it: device.largest_error_deg",
    "limiting_magnitude": "; the device has it: parameters.limiting_magnitude",
}
"""Options of algorithms that follow from the device, and the hint for whoever writes one in `[identifier]`."""

PATHS: Final = profile_paths(Profile)
"""Keys of files and folders, which refer to the folder of the profile that has them."""

_LONGEST_SHOWN: Final = 200
"""Longest part of a `--set` that an error repeats before it says what is wrong with it, characters."""

_FAULT_HINT: Final = "; a fault belongs in a scenario (--scenario) or on the control channel"
FAULT_HINTS: Final = dict.fromkeys(
    ("fault", "faults", "optical", "clock", "phase", "telemetry", "serial", "can"),
    _FAULT_HINT,
)
"""Tables of faults, which a profile does not have, and the hint for whoever writes one there."""
TABLES_WITH_FAULTS: Final = ("device", "links")
"""Tables of a profile in which somebody may write the key of a fault."""
ATTITUDE_KEY_HINTS: Final = {
    key: f"; did you mean attitude.{key}?" for key in ("ra_deg", "dec_deg", "roll_deg", "quaternion_xyzw")
}
"""Keys of an attitude, and the hint for whoever writes one outside its table."""


def load_profile(name_or_path: str = DEFAULT_PROFILE, overrides: Sequence[str] = ()) -> Profile:
    """Read a profile and the profiles it extends, and apply `section.key=value` overrides.

    `orbit=NAME` comes first: it merges a bundled orbit, or a TOML file, with all that belongs to it (`configs/orbits`).

    Raises EmulatorError: each problem names file or option, key and remedy.
    """
    path = find_toml("profile", name_or_path)
    layers = _read_extended(path, 0)
    values: dict[str, Any] = {}
    for _, table in layers:
        if "camera" in table:
            _drop_parameters_of_camera(values)
        values = merge(values, table)
    return _overridden(path, values, layers, overrides)


def _overridden(path: Path, values: dict[str, Any], layers: list[Layer], overrides: Sequence[str]) -> Profile:
    """Apply overrides to the values of a profile, and validate them."""
    if any(override.startswith("camera.") for override in overrides):
        _drop_parameters_of_camera(values)
    presets = [override for override in overrides if override.partition("=")[0].strip() == "orbit"]
    for preset in presets:
        name = preset.partition("=")[2].strip().strip("\"'")
        table = read_toml(find_toml("orbit", name), "orbit")
        values = merge({key: value for key, value in values.items() if key != "orbit"}, table)
        layers.append((f"orbit {name}", table))
    layers += [_apply_override(values, override) for override in overrides if override not in presets]
    faults: list[tuple[Sequence[object], str]] = []
    profile = None
    try:
        profile = Profile.model_validate(values)
    except ValidationError as error:
        listed = problems(error, Profile, values, also=("extends",), hints=FAULT_HINTS | ATTITUDE_KEY_HINTS)
        faults += [(problem.location, f"{problem}{_hint_for_fault(problem)}") for problem in listed]
    name = str(values.get("unit", DEFAULT_UNIT))
    unit = _path_of_unit(name, path.parent)
    if unit is None:
        faults.append((("unit",), f"unit: {not_found('unit', name)}"))
    faults += _problems_of_identifier(values)
    if unit is not None:
        faults += _problems_of_parameters(values.get("parameters"), unit)
    if faults or profile is None:
        named = ((_source_of(layers, location) or f"profile {path}", text) for location, text in faults)
        raise EmulatorError(*(f"{source}: {text}" for source, text in named))
    return profile.read_from(path, layers)


def _hint_for_fault(problem: Problem) -> str:
    """Return the hint for a key that may be that of a fault: one like no other key of its table."""
    may_be = problem.unknown and problem.location[0] in TABLES_WITH_FAULTS and "; known: " in problem.text
    return _FAULT_HINT if may_be else ""


def _problems_of_identifier(values: Mapping[str, Any]) -> Iterator[tuple[Sequence[object], str]]:
    """Yield location and text of the problems of `[identifier]`, whose keys are the options of the algorithm."""
    run, table = values.get("run"), values.get("identifier")
    algorithm = run.get("algorithm", "geometric") if isinstance(run, dict) else "geometric"
    if not isinstance(table, dict) or not isinstance(algorithm, str) or algorithm not in ALGORITHMS:
        return  # reported with the other keys
    options: type = ALGORITHMS[algorithm].options
    model = plain_model(options, frozenset(DEVICE_OPTIONS))
    try:
        model.model_validate(table)
    except ValidationError as error:
        for problem in problems(error, model, table, hints=DEVICE_OPTIONS):
            text = problem.text
            if problem.unknown:
                text = text.replace("unknown key", f"not an option of the algorithm {algorithm}", 1)
            yield ("identifier", *problem.location), f"identifier.{problem.key}".rstrip(".") + f": {text}"


def _problems_of_parameters(table: object, unit: Path) -> Iterator[tuple[Sequence[object], str]]:
    """Yield location and text of the problems of `[parameters]`, whose keys are the parameters of the unit."""
    if not isinstance(table, dict):
        return
    try:
        parameters = load_unit(unit).device_parameters
    except IcdError:
        return  # reported when the unit is loaded
    count = 0
    for number, (name, value) in enumerate(table.items()):
        if count >= MAX_PROBLEMS - 1:
            text = f"parameters: {len(table) - number} more keys are not checked; correct these first"
            yield ("parameters",), text
            return
        for problem in _problems_of_parameter(parameters, name, value):
            yield ("parameters", name), problem
            count += 1


def _problems_of_parameter(parameters: Mapping[str, Parameter], name: str, value: Any) -> Iterator[str]:
    if name not in parameters:
        yield f"parameters.{name}: unknown key{remedy(name, parameters)}"
    elif parameters[name].profile_key:
        yield f"parameters.{name}: set {parameters[name].profile_key} instead"
    else:
        try:
            parameters[name].check(value)
        except ProtocolError as error:
            yield from (f"parameters.{problem}" for problem in error.problems)


def _path_of_unit(name: str, folder: Path) -> Path | None:
    path = folder / find("unit", name)
    try:
        return path if name and path.exists() else None
    except OSError:  # too long a name, for example
        return None


def camera_of(name_or_path: str) -> Camera:
    """Return the camera of a profile (entry point `starid.cameras`, for `starid identify --profile`).

    Raises StaridError, the only error of which `starid` makes one line, where `load_profile` raises its own.
    """
    from starid.camera import Camera

    try:
        profile = load_profile(name_or_path)
    except EmulatorError as error:
        raise StaridError(str(error)) from None
    return Camera.from_dict(profile.camera_values)


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
        values["parameters"] = {
            key: value for key, value in parameters.items() if key not in CAMERA_PARAMETERS
        }


def _replaced_by(present: Iterable[str]) -> set[str]:
    """Return the keys of a table that are excluded by the given ones."""
    return {
        key
        for forms in ALTERNATIVES
        for keys, by in permutations(forms, 2)
        if not by.isdisjoint(present)
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
        value = parse_toml(f"value = {text}")["value"]
    except TomlError:
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
    shown = override if len(override) <= _LONGEST_SHOWN else f"{override[:_LONGEST_SHOWN]}…"
    return f"--set {shown}", layer
