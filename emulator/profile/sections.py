"""The tables of a device profile: their keys, ranges and defaults; docs/profile.md lists them."""

from __future__ import annotations

import math
from itertools import product
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, field_validator, model_validator

from starhil.emulator.simulation.config_model import Date, Strict, UserPath
from starhil.emulator.truth.config import InProfileFolder, profile_paths
from starid.arithmetic.elementary import square
from starid.camera import DEFAULT_FOV_DEG

FrameSeconds = Annotated[float, Field(ge=0.0, le=10.0)]
"""Duration of one stage of a frame, seconds."""

Milliamperes = Annotated[float, Field(ge=0.0, le=10_000.0)]

ParticleRate = Annotated[float, Field(ge=0.0, le=1e6)]
Drift = Annotated[float, Field(ge=-1e5, le=1e5)]
"""Parts per million."""
DriftByTemperature = Annotated[float, Field(ge=-1e3, le=1e3)]
"""Parts per million and degree."""
Jitter = Annotated[float, Field(ge=0.0, le=60.0)]
"""Seconds."""
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
    state_dir: Annotated[UserPath, InProfileFolder()] = ""
    """Folder for state that survives a restart: saved parameters, boot count, CANopen settings. Empty: no
    state is kept."""
    start_unix_s: Date = 1_767_225_600.0
    """Device clock at the start of the run, until it is set: a date, or Unix time; default: 2026-01-01."""


class CatalogConfig(Strict):
    """The star catalogue."""

    path: Annotated[UserPath, InProfileFolder()] = ""
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
    """Field of view along a row, edge to edge; 42 if no focal length is given."""
    focal_px: Annotated[list[FocalLength], Field(min_length=2, max_length=2)] | None = None
    """Focal length along x and y, instead of `fov_deg`."""
    focal_mm: Annotated[float, Field(ge=0.1, le=10_000.0)] | None = None
    """Focal length, instead of `fov_deg`, for pixels of `sensor.pixel_um`."""
    centre_px: Annotated[list[PixelPosition], Field(min_length=2, max_length=2)] | None = None
    """Position of the optical axis on the pixel array; default: the centre."""
    model: Literal["pinhole", "equidistant", "flat"] = "pinhole"
    """Projection of the lens."""
    distortion: list[DistortionTerm] = Field(default_factory=list, max_length=5)
    """Brown–Conrady coefficients k1, k2, p1, p2, k3."""

    def values(self, pixel_um: float) -> dict[str, Any]:
        """Return the keys that `starid.camera.Camera.from_dict` reads, for pixels of this width."""
        values = self.model_dump(exclude_none=True)
        if self.focal_mm is not None:
            focal_px = 1000.0 * values.pop("focal_mm") / pixel_um
            values["focal_px"] = [focal_px, focal_px]
        if "focal_px" in values:
            values.setdefault("centre_px", [(self.width - 1) / 2, (self.height - 1) / 2])
        else:
            values.setdefault("fov_deg", DEFAULT_FOV_DEG)
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
    tracking_stars: Literal[0] | Annotated[int, Field(ge=2, le=50)] = 2
    """Least number of matched stars in tracking, where few stars near the predicted attitude may be fainter (3 sigmas); 0:
    `min_stars_matched`, as lost in space."""
    largest_error_deg: Annotated[float, Field(ge=0.001, le=10.0)] = 0.1
    """Largest error across or about the boresight: an attitude is invalid if, by its own uncertainty, a larger one is likelier
    than 1e-4. Not of features alone (`identifier.refinement = false`)."""
    wrong_predictions: Annotated[float, Field(ge=0.0, le=1.0)] = 0.001
    """Share of the predicted attitudes that are assumed to be wrong by more than their uncertainty, because the body accelerates. The
    larger it is, the more stars an attitude in tracking needs."""
    tracking_windows: bool = False
    """Whether the unit searches only windows around the predicted stars when it tracks, and the whole image only if that fails."""
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
                min(rows[i][i], rows[j][j]) >= 0.0
                and square(rows[i][j]) <= 1.000001 * rows[i][i] * rows[j][j]
            )
            if not possible or not math.isclose(rows[i][j], rows[j][i], rel_tol=1e-6):
                raise ValueError(f"row {i + 1}, column {j + 1} is not that of a covariance matrix")
        return rows

    def matrix(self) -> list[list[float]] | None:
        """Return the covariance; None if no errors are known."""
        if self.covariance is not None or self.sigma is None:
            return self.covariance
        rows = [
            [square(sigma) if row == column else 0.0 for column in range(9)]
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

    quiet_s: ParticleRate | None = None
    """Particles per second outside the South Atlantic Anomaly. Default: with an orbit 2 on each cm² of the detector, else 0."""
    anomaly_s: ParticleRate | None = None
    """Additional particles per second in the centre of the anomaly at an altitude of 500 km, with an orbit. Default:
    500 on each cm² of the detector."""


class ImagesConfig(Strict):
    """Source of images instead of rendering; `[camera]` then describes the camera of the images."""

    folder: Annotated[UserPath, InProfileFolder()] = ""
    """Folder of PNG, TIFF, JPEG or BMP images, used in the order of their names; relative to the profile."""
    capture: Annotated[int, Field(ge=0, le=99)] | str = ""
    """Number of a camera (0 is the first), or a video file, as in OpenCV's `VideoCapture`."""
    repeat: bool = True
    """Whether to start again after the last image in the folder."""
    dark: Annotated[UserPath, InProfileFolder()] = ""
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
            for key in profile_paths(ImagesConfig)
            if (value := getattr(self, key))
        }
        return {**self.model_dump(), "capture": str(self.capture), **files}


class ClockConfig(Strict):
    """Errors of the device's clock, and of the time that a result takes."""

    drift_ppm: Drift = 0.0
    """Drift of the clock at 25 °C, parts per million; positive: it is fast."""
    drift_ppm_c: DriftByTemperature = 0.0
    """Change of the drift per degree of the detector's temperature."""
    jitter_s: Jitter = 0.0
    """Standard deviation of the time tags of exposures, seconds."""
    latency_jitter_s: Jitter = 0.0
    """Largest additional delay of a result; its delays are uniform from 0 to this."""


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
    overlapped: bool = False
    """Whether an image is processed while the next one is exposed: its result comes a period later. Otherwise, it is
    processed right after its own exposure."""

    def processing_s(self, *, tracking: bool) -> float:
        """Return the time of detection and identification of a frame without stars, seconds."""
        return self.detect_s + (self.identify_tracking_s if tracking else self.identify_lost_s)

    def busy_s(self, exposure_s: float, *, tracking: bool) -> float:
        """Return how long a period's exposure, read-out and processing take: at the same time if they overlap, seconds."""
        capture_s, processing_s = exposure_s + self.readout_s, self.processing_s(tracking=tracking)
        return max(capture_s, processing_s) if self.overlapped else capture_s + processing_s


class SerialConfig(Strict):
    """The serial link."""

    port: str = "auto"
    """`auto` (a pty), a device path, `listen://HOST:PORT`, or `off`."""
    dialect: Literal["a", "b", "c"] = "b"
    """Format of replies: [which one an OBC expects](icd/cubestar.md#serial-line)."""
    baud: Annotated[int, Field(ge=1200, le=4_000_000)] = 115_200
    """Bit rate."""
    pace: bool = True
    """Whether a message arrives, whole, only at the time at which its last byte would at the bit rate."""
    symlink: UserPath = ""
    """Path of a symbolic link to the pty, made when the unit is ready, removed at the end."""


class CanConfig(Strict):
    """The CAN link."""

    channel: str = "auto"
    """`auto` (vcan0 if available, else the TCP hub; a new hub if another emulator there has the address), a python-can
    channel, or `off`."""
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
