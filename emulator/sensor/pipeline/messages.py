"""Requests to the image pipeline, and its results, which are pickled between the processes."""

from __future__ import annotations

import math
import pickle
import struct
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Final, Self, TypeAlias

from starhil.emulator.truth.source import TruthState
from starid.arithmetic.arrays import Array
from starid.attitude import Attitude
from starid.identification.solution import FeatureReport

Quaternion: TypeAlias = tuple[float, float, float, float]
Triple: TypeAlias = tuple[float, float, float]
Matrix: TypeAlias = tuple[Triple, Triple, Triple]

ZERO: Final[Triple] = (0.0, 0.0, 0.0)
IDENTITY: Final[Quaternion] = (0.0, 0.0, 0.0, 1.0)


def as_quaternion(attitude: Attitude) -> Quaternion:
    """Return the quaternion of an attitude as Python floats, scalar last."""
    x, y, z, w = attitude.quaternion_xyzw.tolist()
    return (x, y, z, w)


def as_triple(vector: Array) -> Triple:
    """Return a vector (3,) as Python floats."""
    x, y, z = vector.tolist()
    return (x, y, z)


def as_rows(matrix: Array) -> Matrix:
    """Return a matrix (3, 3) as Python floats."""
    first, second, third = matrix
    return (as_triple(first), as_triple(second), as_triple(third))


LENGTH: Final = struct.Struct("<I")
"""Length prefix of each pickled message between the emulator and its worker."""


def with_length(message: object) -> bytes:
    """Return a message between the emulator and its worker; a text is the last one, why the worker ends."""
    data = pickle.dumps(message, protocol=pickle.HIGHEST_PROTOCOL)
    return LENGTH.pack(len(data)) + data


IMAGE_EDGES: Final = (1024, 512, 256, 128, 64)
"""Edges of the square images for download, pixels, indexed by the published enumeration."""


@dataclass(frozen=True)
class _Chosen:
    """Some of the values that a mapping has by name."""

    @classmethod
    def of(cls, values: Mapping[str, Any]) -> Self:
        """Take the fields from a mapping, which may have more."""
        return cls(**{name: values[name] for name in cls.__dataclass_fields__})


@dataclass(frozen=True)
class SolverSettings(_Chosen):
    """Device parameters used in detection and identification, named as in the interface definition."""

    detection_threshold: float
    star_threshold: float
    max_star_pixels: int
    min_star_pixels: int
    limiting_magnitude: float
    max_stars_matched: int
    min_stars_matched: int
    error_margin: int
    window_width: int
    tracking_margin: int
    validation_margin: int
    search_width: float
    centroid_x: float
    centroid_y: float
    focal_length: float
    k1: float
    k2: float
    p1: float
    p2: float


@dataclass(frozen=True)
class SolvingOptions(_Chosen):
    """Keys of `[device]` in a profile that concern the pipeline."""

    dark_frames: int
    tracking_stars: int
    tracking_windows: bool
    largest_error_deg: float
    wrong_predictions: float


@dataclass(frozen=True)
class PipelineSetup:
    """Configuration of the pipeline, fixed for a run."""

    camera: dict[str, Any]
    sensor: dict[str, Any]
    sky: dict[str, Any]
    identifier: dict[str, Any]
    """Fields of the camera, the sensor model and the sky objects, and options of the algorithm, by name."""
    device: SolvingOptions
    catalog_path: str
    epoch: float
    """Catalogue file (empty: the installed one) and the Julian year of the star positions."""
    algorithm: str
    settings: SolverSettings
    """Settings of the frames with which the pipeline is warmed up, apart from the camera's constants."""
    seed: int
    build_in_background: bool = False
    """Whether frames are solved with the current star index while another is being built. If false, frames wait for
    the new index, so that a run on the stepped clock is reproducible byte for byte."""
    previews: bool = False
    """Whether frames may be displayed, so that previews must be possible."""
    calibration: list[list[float]] | None = None
    """Covariance (9, 9) of the calibrated camera's parameters, as in `starid.camera.calibration.Calibration`; None: they are
    exact."""
    exposure_s: float = 0.2
    """Exposure in which the limit of the detector is measured, for the algorithms that count stars."""
    images: dict[str, Any] = field(default_factory=dict)
    """Source of images instead of rendering: keys of `[images]` in a profile."""


def camera_constants(camera: Mapping[str, Any]) -> dict[str, Any]:
    """Return the parameters of a unit that is calibrated to a camera: focal length, centre and distortion, in pixels."""
    focal_x, focal_y = camera["focal_px"]
    names = ("focal_length", "centroid_x", "centroid_y", "k1", "k2", "p1", "p2")
    values = (math.sqrt(focal_x * focal_y), *camera["centre_px"], *camera["distortion"][:4])
    return dict(zip(names, values, strict=True))


DIRECTION_BITS: Final = 32
"""Number of bits of a component of a star's direction in the unit's memory."""


@dataclass(frozen=True)
class CatalogUpset:
    """A bit flipped in the unit's star catalogue."""

    hip: int
    component: int
    """Component of the direction: 0, 1 or 2 for x, y or z."""
    bit: int
    """Bit of the component in single precision, 0 the least significant."""


@dataclass(frozen=True)
class FrameRequest:
    """Request to render an exposure and, optionally, to solve it."""

    index: int
    """Number of the frame since the start of the run, which together with the seed determines the noise."""
    truth: TruthState
    """Truth of the sensor at mid-exposure; without a date, only typed bodies are rendered."""
    exposure_s: float
    gain: float
    settings: SolverSettings
    solve: bool = True
    """Whether to detect and identify stars; if false, the image is only rendered and kept for download."""
    predicted: Attitude | None = None
    """Predicted attitude at mid-exposure, for tracking; None: lost in space."""
    prediction_covariance: Array | None = None
    """Covariance (3, 3) of its error, rad², sensor frame; None: not known."""
    prediction_freedom: float = math.inf
    """Degrees of freedom of that."""
    predicted_rate_rad_s: Triple | None = None
    """Body rate at the prediction; None: not known."""
    faults: dict[str, Any] = field(default_factory=dict)
    """Fields of the sky objects that are overridden by the control channel."""
    temperature_c: float | None = None
    """Temperature of detector and lens, °C; None: as in the sensor model."""
    particles_s: float = 0.0
    """Particles per second that hit the detector, in addition to the sky's particles."""
    upsets: tuple[CatalogUpset, ...] = ()
    """Bits flipped by radiation in the unit's star catalogue."""
    observer_velocity: Array | None = None
    """Velocity (3,) of the sensor relative to the barycentre assumed by the device, ICRS, m/s, to correct aberration;
    None: no correction."""
    preview: bool = False
    """Whether to return the image too, compressed for display."""
    begin_s: float | None = None
    """Simulation time at which the exposure begins, seconds; None: an image by itself, without an afterimage of others."""
    pipeline_starts: int = 0
    """How often the pipeline has been started: one that is restarted has lost the afterimage."""


@dataclass(frozen=True)
class IndexRequest:
    """Request to build the star index that frames with these settings need; those after it wait for it."""

    settings: SolverSettings
    upsets: tuple[CatalogUpset, ...] = ()
    rehearsal: FrameRequest | None = None
    """Frame to take without a result, so that all that it needs is there before the first one that counts."""


@dataclass(frozen=True)
class IndexReady:
    """Message that the star index of a request is built."""


@dataclass(frozen=True)
class Preview:
    """An image for display, and its overlay."""

    jpeg: bytes
    """The image, 8 bits, stretched so that faint stars are visible."""
    overlay: bytes = b"{}"
    """The overlay: a JSON object, made in the worker so that it takes no time on the links."""


@dataclass(frozen=True)
class MatchedStar:
    """An identified star."""

    hip: int
    """Hipparcos number."""
    x: float
    y: float
    """Position, pixels."""
    magnitude: float
    """Measured magnitude."""
    snr: float
    """Signal-to-noise ratio."""
    vector: Triple
    """Measured direction in the sensor frame, by the calibrated camera of the quaternion."""
    icrs: Triple
    """Modelled direction: that of the star in the catalogue, in ICRS, without aberration."""


@dataclass(frozen=True)
class FrameResult:
    """Result of a frame request."""

    index: int
    """Number of the frame since the start of the run."""
    valid: bool = False
    reason: str = "no_frame"
    """Whether the attitude is valid, and the reason if not, as named in the interface definition."""
    tracked: bool = False
    """Whether it was solved from the prediction, or, if invalid, whether that was attempted."""
    quaternion_xyzw: Quaternion = (0.0, 0.0, 0.0, 0.0)
    """Attitude ICRS→sensor at mid-exposure; zeros if invalid."""
    sigma_cross_arcsec: float = 0.0
    sigma_roll_arcsec: float = 0.0
    """Standard deviation about the axis across the boresight about which it is largest, and about the boresight."""
    covariance_rad2: Matrix | None = None
    """Covariance of the rotation vector of the error, sensor frame; None if invalid."""
    freedom: float = math.inf
    """Degrees of freedom from which its scale was estimated."""
    rate_rad_s: Triple | None = None
    """Body rate, if the algorithm estimates one."""
    detected: int = 0
    refused: int = 0
    matched: int = 0
    """Number of detected stars, of rejected detections, and of identified stars."""
    stars: tuple[MatchedStar, ...] = ()
    """The brightest identified stars, brightest first."""
    probability_false: float = 1.0
    rms_px: float = 0.0
    """As in `starid.identification.solution.Solution`."""
    features: FeatureReport | None = None
    """How an algorithm of the thesis worked; None for `geometric`."""
    false_detected: int = 0
    """Number of detections that are false stars of a rendered image, if an algorithm of the thesis ran."""
    false_removed: int = 0
    """Number of those that its false-star filter removed."""
    index_pending: bool = False
    """Whether the frame was solved with the star index of earlier settings, because a new one is being built."""
    background_dn: float = 0.0
    noise_dn: float = 0.0
    """Level and noise of the background, counts."""
    in_field: tuple[str, ...] = ()
    """Bodies in the field of view or within their exclusion angles: `sun`, `moon`, `earth`."""
    solved: bool = True
    """Whether stars were to be detected and identified."""
    render_s: float = 0.0
    detect_s: float = 0.0
    identify_s: float = 0.0
    """Wall time of each step, for the log but not for telemetry."""
    preview: Preview | None = field(default=None, repr=False, compare=False)
    """The image for display, if it was requested."""


@dataclass(frozen=True)
class ImageRequest:
    """Request for the last image at 8 bits, scaled to a square of `edge` pixels; `edge` 0: unscaled."""

    edge: int


@dataclass(frozen=True)
class ImageResult:
    """An 8-bit image, row by row; `frame` is the number of the exposure, or -1 if there is no image yet."""

    width: int
    height: int
    frame: int
    pixels: bytes


@dataclass(frozen=True)
class JpgRequest:
    """Request to compress a square 8-bit image of `edge` pixels as JPEG; `quality` 100 loses least, 1 most."""

    edge: int
    pixels: bytes
    quality: int


@dataclass(frozen=True)
class JpgResult:
    """A JPEG file."""

    data: bytes


@dataclass(frozen=True)
class PipelineReady:
    """Message that the pipeline is ready."""

    camera: dict[str, Any]
    """Fields of the camera, with derived constants."""
    stars: int
    seconds: float


@dataclass(frozen=True)
class Failure:
    """Message that a request, or the start of the pipeline, failed."""

    text: str


class PipelineEnded(Failure):
    """The pipeline has ended without a reply to the request."""
