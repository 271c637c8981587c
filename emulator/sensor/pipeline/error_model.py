"""A stand-in for the image pipeline: attitudes are the truth with the errors of a sensor, without images.

For runs in which traffic and modes matter and the sky does not, thousands of times faster than rendering. The result
of a frame depends only on the request and the seed:

- The number of detected stars follows from the density of stars, the field of view, exposure, gain, threshold and
  smear, and from covered parts of the lens (`blocked_share`); other objects in the sky have no effect.
- A frame with fewer stars than `min_stars_matched` fails with `too_few_stars`; a camera calibration that is wrong
  by more than `validation_margin` pixels within the field fails with `no_match`; a predicted attitude beyond
  `tracking_margin` plus `search_width` pixels fails with `prediction_lost`.
- Otherwise the brightest `REPORTED_STARS` are somewhere in the field, measured with the error of a centroid; their
  numbers and magnitudes are chance. Each axis of the attitude's error is normal, cut off at `LARGEST_SIGMA`, with the
  stated standard deviation.
"""

from __future__ import annotations

import math
import random
from typing import Any, Final

from starhil.emulator.sensor.pipeline.client import PipelineRequest, ReplyCallback
from starhil.emulator.sensor.pipeline.jpg import compress_image
from starhil.emulator.sensor.pipeline.messages import (
    FrameRequest,
    FrameResult,
    ImageRequest,
    ImageResult,
    IndexRequest,
    JpgRequest,
    MatchedStar,
    PipelineEnded,
    PipelineReady,
    PipelineSetup,
    Quaternion,
    Triple,
    as_quaternion,
)
from starhil.emulator.sensor.star_count import STARS_TO_V6, mean_stars
from starhil.emulator.simulation.signal import Signal
from starid.arithmetic.elementary import acos, hypot, log10, square
from starid.camera import Camera

ARCSEC: Final = math.radians(1.0 / 3600.0)

LIMIT_V: Final = 6.0
"""Limiting magnitude at 0.1 s exposure, unit gain and a threshold of 5 sigma, at rest."""
CENTROID_PX: Final = 0.1
"""Standard deviation of a star's position along each axis, pixels."""
ROLL_ARM: Final = 0.4
"""Root mean square distance of the stars from the boresight along one axis, as a share of the field's width."""
LARGEST_SIGMA: Final = 4.0
REPORTED_STARS: Final = 3
"""Number of stars with measured and catalogue directions."""
STARS_IN_CATALOGUE: Final = 118_218
"""Largest Hipparcos number of a star."""
SMEAR_PX: Final = 3.0
"""Length of a trail at which the light per pixel is halved, pixels."""


class ErrorModel:
    """The pipeline as an error model; requests are answered in the call that submits them.

    `end` ends it unexpectedly, like the death of a worker process.
    """

    pending: Final = 0

    def __init__(self, setup: PipelineSetup) -> None:
        self._setup = setup
        self._camera = Camera.from_dict(setup.camera)
        self._constants: dict[str, Any] = self._camera.to_dict()
        self._focal_px = math.sqrt(math.prod(self._camera.focal_px))
        self._running = True
        self._last_image = -1
        self.ended = Signal[str]("end of the image pipeline")
        """The pipeline has ended unexpectedly, and why."""
        self.watchers: set[object] = set()
        """Viewers of the frames, for which this pipeline has no images."""

    async def start(self) -> PipelineReady:
        """Return at once: nothing is loaded."""
        self._running = True
        return PipelineReady(self._constants, round(STARS_TO_V6), 0.0)

    async def restart(self) -> PipelineReady:
        """Start again after the end."""
        return await self.start()

    async def settle(self) -> None:
        """Return at once: nothing is ever pending."""

    async def close(self) -> None:
        """Do nothing: there is no process."""

    def end(self, reason: str) -> None:
        self._running = False
        self.ended.emit(reason)

    def prepare(self, request: IndexRequest) -> None:
        """Do nothing: there is no star index."""

    def submit(self, request: PipelineRequest, done: ReplyCallback) -> None:
        if not self._running:
            done(PipelineEnded("error model: not running"))
        elif isinstance(request, ImageRequest):
            done(self._image(request.edge))
        elif isinstance(request, JpgRequest):
            done(compress_image(request))
        else:
            self._last_image = request.index
            done(self._solve(request) if request.solve else FrameResult(request.index, solved=False))

    def _image(self, edge: int) -> ImageResult:
        """Return a ramp that differs from frame to frame."""
        if self._last_image < 0:
            return ImageResult(edge or 1, edge or 1, -1, b"")
        width, height = (edge, edge) if edge else (self._camera.width, self._camera.height)
        row = bytes((column + self._last_image) & 0xFF for column in range(width))
        return ImageResult(width, height, self._last_image, row * height)

    def _solve(self, request: FrameRequest) -> FrameResult:
        random_of_frame = random.Random(self._setup.seed << 40 ^ request.index)  # noqa: S311 (noise)
        settings = request.settings
        tracked = request.predicted is not None
        expected = self._expected_stars(request)
        detected = max(0, round(random_of_frame.gauss(expected, math.sqrt(expected))))
        matched = min(detected, settings.max_stars_matched)
        reason = self._failure(request, matched)
        if reason:
            return FrameResult(request.index, reason=reason, tracked=tracked, detected=detected)
        cross_rad = CENTROID_PX / self._focal_px / math.sqrt(matched)
        roll_rad = CENTROID_PX / (ROLL_ARM * self._camera.width) / math.sqrt(matched)
        error = [
            sigma * min(max(random_of_frame.gauss(0.0, 1.0), -LARGEST_SIGMA), LARGEST_SIGMA)
            for sigma in (cross_rad, cross_rad, roll_rad)
        ]
        return FrameResult(
            request.index,
            valid=True,
            reason="ok",
            tracked=tracked,
            quaternion_xyzw=turned(as_quaternion(request.truth.attitude), error),
            sigma_cross_arcsec=cross_rad / ARCSEC,
            sigma_roll_arcsec=roll_rad / ARCSEC,
            covariance_rad2=(
                (square(cross_rad), 0.0, 0.0),
                (0.0, square(cross_rad), 0.0),
                (0.0, 0.0, square(roll_rad)),
            ),
            detected=detected,
            matched=matched,
            stars=self._stars(request, random_of_frame),
            probability_false=1e-12,
            rms_px=CENTROID_PX,
        )

    def _stars(self, request: FrameRequest, random_of_frame: random.Random) -> tuple[MatchedStar, ...]:
        """Return stars somewhere in the field, each measured with the error of a centroid."""
        centre_x, centre_y = self._constants["centre_px"]
        attitude, stars = as_quaternion(request.truth.attitude), []
        for _ in range(REPORTED_STARS):
            true_x = random_of_frame.uniform(0.0, self._camera.width - 1.0)
            true_y = random_of_frame.uniform(0.0, self._camera.height - 1.0)
            x, y = (
                true + CENTROID_PX * min(max(random_of_frame.gauss(0.0, 1.0), -LARGEST_SIGMA), LARGEST_SIGMA)
                for true in (true_x, true_y)
            )
            true = unit_vector(true_x - centre_x, true_y - centre_y, self._focal_px)
            stars.append(
                MatchedStar(
                    hip=random_of_frame.randint(1, STARS_IN_CATALOGUE),
                    x=x,
                    y=y,
                    magnitude=random_of_frame.uniform(2.0, LIMIT_V),
                    snr=50.0,
                    vector=unit_vector(x - centre_x, y - centre_y, self._focal_px),
                    icrs=in_icrs(true, attitude),
                )
            )
        return tuple(sorted(stars, key=lambda star: star.magnitude))

    def _expected_stars(self, request: FrameRequest) -> float:
        """Return the mean number of detected stars in the field."""
        settings = request.settings
        x, y, z = request.truth.rate_rad_s.tolist()
        trail_px = (
            self._focal_px * hypot(x, y) + ROLL_ARM * self._camera.width * abs(z)
        ) * request.exposure_s
        light = request.exposure_s / 0.1 * request.gain * 5.0 / settings.detection_threshold
        reach = LIMIT_V + 2.5 * log10(light / (1.0 + trail_px / SMEAR_PX))
        faintest = min(reach, settings.limiting_magnitude)
        seen = 1.0 - float(request.faults.get("blocked_share", 0.0))
        return mean_stars(self._constants, faintest) * seen

    def _failure(self, request: FrameRequest, matched: int) -> str:
        """Return the reason why a frame cannot be solved, or an empty text."""
        settings = request.settings
        if matched < settings.min_stars_matched:
            return "too_few_stars"
        if self._calibration_error_px(request) > settings.validation_margin:
            return "no_match"
        if request.predicted is not None:
            off_px = self._focal_px * angle_between(
                as_quaternion(request.predicted), as_quaternion(request.truth.attitude)
            )
            if off_px > settings.tracking_margin + settings.search_width:
                return "prediction_lost"
        return ""

    def _calibration_error_px(self, request: FrameRequest) -> float:
        """Return the error of the unit's calibration at the edge of the field, pixels."""
        settings, constants = request.settings, self._constants
        k1, k2, p1, p2, _ = constants["distortion"]
        edge = 0.5 * self._camera.width / self._focal_px
        turn = hypot(
            settings.centroid_x - constants["centre_px"][0], settings.centroid_y - constants["centre_px"][1]
        )
        radial = settings.focal_length * (
            1.0 + settings.k1 * square(edge) + settings.k2 * square(square(edge))
        )
        true_radial = self._focal_px * (1.0 + k1 * square(edge) + k2 * square(square(edge)))
        tangential = self._focal_px * hypot(settings.p1 - p1, settings.p2 - p2) * square(edge)
        # a shift of the centre is nearly a rotation; what remains is its projection
        error_px: float = abs(radial - true_radial) * edge + 3.0 * tangential + turn * square(edge)
        return error_px


def turned(attitude: Quaternion, turn_rad: list[float]) -> Quaternion:
    """Return the attitude of a sensor that has turned by a small rotation vector in its own frame."""
    a, b, c = (-0.5 * component for component in turn_rad)
    x, y, z, w = attitude
    d = 1.0
    a, b, c, d = (
        d * x + a * w + b * z - c * y,
        d * y - a * z + b * w + c * x,
        d * z + a * y - b * x + c * w,
        d * w - a * x - b * y - c * z,
    )
    length = math.copysign(math.sqrt(a * a + b * b + c * c + d * d), d)
    return (a / length, b / length, c / length, d / length)


def unit_vector(x: float, y: float, z: float) -> Triple:
    length = math.sqrt(x * x + y * y + z * z)
    return (x / length, y / length, z / length)


def in_icrs(vector: Triple, attitude: Quaternion) -> Triple:
    """Return a vector of the sensor frame in ICRS, by the inverse rotation of an attitude."""
    x, y, z, w = attitude
    a, b, c = vector
    i, j, k = b * z - c * y, c * x - a * z, a * y - b * x  # v × u, with u the vector part of the quaternion
    # v + 2w (v × u) + 2 (v × u) × u
    return (
        a + 2.0 * (w * i + j * z - k * y),
        b + 2.0 * (w * j + k * x - i * z),
        c + 2.0 * (w * k + i * y - j * x),
    )


def angle_between(one: Quaternion, other: Quaternion) -> float:
    """Return the angle between two attitudes, radians."""
    return 2.0 * acos(min(1.0, abs(math.fsum(a * b for a, b in zip(one, other, strict=True)))))
