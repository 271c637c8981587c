"""What crosses between the device and its picture pipeline: a request for a frame, and what came of it.

Plain values only, so that they travel between processes and compare equal in tests.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass, field
from typing import Any, Final, TypeAlias

Quaternion: TypeAlias = tuple[float, float, float, float]
Triple: TypeAlias = tuple[float, float, float]

ZERO: Final[Triple] = (0.0, 0.0, 0.0)
IDENTITY: Final[Quaternion] = (0.0, 0.0, 0.0, 1.0)

LENGTH: Final = struct.Struct("<I")
"""Length that goes before each pickled message between the emulator and its worker process."""

IMAGE_EDGES: Final = (1024, 512, 256, 128, 64)
"""Edges of the square images that can be downloaded, by the number of the published enumeration."""


@dataclass(frozen=True)
class PipelineSetup:
    """What the pipeline is made of; fixed for a run.

    Attributes
    ----------
    camera, sensor, sky, identifier
        Values of the camera, fields of the sensor model, of the sky's objects and options of the algorithm, by name.
    catalog_path, epoch
        The catalogue's file (empty: the installed one) and the Julian year of its positions.
    algorithm
        `geometric`, `lsi` or `rsi`.
    seed
        Seed of all noise.
    build_beside
        Answer with the star index in force while another is built; without it frames wait, so that the same run gives
        the same bytes on a clock that waits too.
    """

    camera: dict[str, Any]
    sensor: dict[str, Any]
    sky: dict[str, Any]
    identifier: dict[str, Any]
    catalog_path: str
    epoch: float
    algorithm: str
    seed: int
    build_beside: bool = False


@dataclass(frozen=True)
class SolverSettings:
    """Parameters of the device that reach detection, identification and attitude; names as in the interface definition."""

    detection_threshold: float = 5.0
    star_threshold: float = 3.0
    max_star_pixels: int = 250
    min_star_pixels: int = 2
    limiting_magnitude: float = 6.0
    max_stars_matched: int = 60
    min_stars_matched: int = 4
    error_margin: int = 100
    window_width: int = 21
    tracking_margin: int = 6
    validation_margin: int = 2
    search_width: float = 10.0
    centroid_x: float = 468.0
    centroid_y: float = 468.0
    focal_length: float = 1220.4842
    k1: float = 0.0
    k2: float = 0.0
    p1: float = 0.0
    p2: float = 0.0


@dataclass(frozen=True)
class FrameRequest:
    """One exposure to be made and, where asked for, solved.

    Attributes
    ----------
    index
        Number of the frame since the start of the run; with the seed it decides the noise.
    attitude_xyzw, rate_rad_s
        Truth at mid-exposure: quaternion ICRS→sensor, body rate in the sensor frame.
    exposure_s, gain
        Exposure in seconds and analog gain.
    solve
        Detect and identify; without it the frame is made and kept.
    predicted_xyzw
        Attitude expected at mid-exposure, from which to track; None: lost in space.
    settings
        Parameters of detection and identification.
    faults
        Fields of the sky's objects that take the place of the run's own, as the control channel sets them.
    """

    index: int
    attitude_xyzw: Quaternion
    rate_rad_s: Triple
    exposure_s: float
    gain: float
    solve: bool = True
    predicted_xyzw: Quaternion | None = None
    settings: SolverSettings = field(default_factory=SolverSettings)
    faults: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class MatchedStar:
    """A detection that was identified: Hipparcos number, position in pixels, measured magnitude, signal to noise."""

    hip: int
    x: float
    y: float
    magnitude: float
    snr: float


@dataclass(frozen=True)
class FrameResult:
    """What came of a frame.

    Attributes
    ----------
    valid, reason
        Whether the attitude holds, and why not, by the names of the interface definition.
    tracked
        Solved from the prediction.
    quaternion_xyzw
        Attitude ICRS→sensor at mid-exposure; zeros where invalid.
    sigma_cross_arcsec, sigma_roll_arcsec
        One sigma per axis across, and about, the boresight.
    rate_rad_s
        Body rate where the algorithm itself estimates one.
    detected, refused, matched
        Numbers of stars found, of detections refused as stars, of stars identified.
    stars
        The brightest identified ones, brightest first.
    probability_false, rms_px
        As the identification reports them.
    index_pending
        Solved with the star index of the settings before; the one for those of the request is being built.
    background_dn, noise_dn
        Level and noise of the background, counts.
    render_s, detect_s, identify_s
        Wall time that the steps took, for the log; never in telemetry.
    """

    index: int
    valid: bool = False
    reason: str = "no_frame"
    tracked: bool = False
    quaternion_xyzw: Quaternion = (0.0, 0.0, 0.0, 0.0)
    sigma_cross_arcsec: float = 0.0
    sigma_roll_arcsec: float = 0.0
    rate_rad_s: Triple | None = None
    detected: int = 0
    refused: int = 0
    matched: int = 0
    stars: tuple[MatchedStar, ...] = ()
    probability_false: float = 1.0
    rms_px: float = 0.0
    index_pending: bool = False
    background_dn: float = 0.0
    noise_dn: float = 0.0
    solved: bool = True
    render_s: float = 0.0
    detect_s: float = 0.0
    identify_s: float = 0.0


@dataclass(frozen=True)
class ImageRequest:
    """Ask for the last frame as a square image of `edge` pixels, or as it is with `edge` 0; 8 bit."""

    edge: int


@dataclass(frozen=True)
class ImageResult:
    """An image, row by row; `frame` is the number of the frame that it shows, or -1 if there was none."""

    width: int
    height: int
    frame: int
    pixels: bytes


@dataclass(frozen=True)
class Warm:
    """The pipeline is ready.

    Attributes
    ----------
    camera
        The camera with all its constants worked out.
    stars
        Number of stars in the catalogue.
    seconds
        Wall time that it took.
    """

    camera: dict[str, Any]
    stars: int
    seconds: float


@dataclass(frozen=True)
class Failure:
    """The pipeline could not do what was asked."""

    text: str
