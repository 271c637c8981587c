"""The picture pipeline: renders what the sensor sees, detects stars, identifies them. All numerics of a run are here."""

from __future__ import annotations

import itertools
import math
import time
from dataclasses import replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from starhil.emulator.errors import EmulatorError
from starhil.emulator.guard import one_line
from starhil.emulator.pipeline.binning import mean_over_squares
from starhil.emulator.pipeline.frames import (
    ZERO,
    Failure,
    FrameRequest,
    FrameResult,
    ImageRequest,
    ImageResult,
    MatchedStar,
    PipelineSetup,
    SolverSettings,
    Warm,
)
from starhil.emulator.pipeline.identifiers import IdentifierChoice, Identifiers
from starhil.emulator.pipeline.precompile import picture_was_compiled, start_helper
from starhil.emulator.sensor.model import SensorModel
from starhil.emulator.sensor.renderer import Frame, Renderer
from starhil.emulator.sky.objects import SkyObjects
from starid.attitude import Attitude
from starid.camera import Camera
from starid.catalog import load_catalog
from starid.errors import StaridError
from starid.imaging.detection import Detections, DetectionSettings, detect
from starid.interface import StarIdentifier
from starid.solution import Reason, Solution

STARS_SENT: Final = 16
"""Identified stars that go back to the device, the brightest."""

BYTE_LEVELS: Final = 8
"""Bits of an image for download."""

REASONS: Final[dict[Reason, str]] = {
    Reason.OK: "ok",
    Reason.TOO_FEW_STARS: "too_few_stars",
    Reason.NO_MATCH: "no_match",
    Reason.AMBIGUOUS: "ambiguous",
    Reason.RESIDUAL: "residual",
    Reason.PREDICTION_LOST: "prediction_lost",
    Reason.BAD_INPUT: "bad_input",
}
"""Reason of the identification → its name in telemetry."""


_WARM_UP_RATES_RAD_S: Final = ((1e-3, 0.0, 0.0), (0.03, 0.0, 0.0))
"""Rates at which the stars of a default exposure are round, and at which they leave trails of some pixels."""


def make_picture(setup: PipelineSetup) -> tuple[Picture, Warm] | Failure:
    """Make the pipeline and solve a first frame with it, or say in one line why it cannot be."""
    begin = time.perf_counter()
    try:
        picture = Picture(setup)
        picture.warm_up()
    except (EmulatorError, StaridError) as error:
        return Failure(str(error))
    except Exception as error:  # noqa: BLE001 (in one line, instead of a traceback of a process that is gone)
        return Failure(f"picture pipeline: internal error: {one_line(error)}")
    warm = Warm(picture.camera.to_dict(), len(picture.catalog), time.perf_counter() - begin)
    return picture, warm


class Picture:
    """Renderer, detection and identifier of a run, with what they keep between frames."""

    def __init__(self, setup: PipelineSetup) -> None:
        self._setup = setup
        self.camera = Camera.from_dict(setup.camera)
        self.catalog = load_catalog(setup.catalog_path or None, setup.epoch)
        self._sensor = SensorModel().with_(**setup.sensor)
        self._renderer = Renderer(self.camera, self.catalog, self._sensor, setup.seed)
        self._identifiers = Identifiers(lambda choice: choice.make(self.catalog), beside=setup.build_beside)
        self._sky = SkyObjects.from_dict(setup.sky)
        self._last: Frame | None = None

    def warm_up(self) -> None:
        """Make and solve frames of the default settings, lost in space and tracking, so that no kernel is cold.

        A kernel that is compiled in a run stops the frames for seconds, so the stars leave trails on some.
        """
        camera = self.camera
        k1, k2, p1, p2, _ = camera.distortion
        settings = SolverSettings(
            focal_length=math.sqrt(camera.focal_px[0] * camera.focal_px[1]),
            centroid_x=camera.centre_px[0],
            centroid_y=camera.centre_px[1],
            k1=k1,
            k2=k2,
            p1=p1,
            p2=p2,
        )
        here = (0.0, 0.0, 0.0, 1.0)
        helper = start_helper() if picture_was_compiled() else None
        request = FrameRequest(
            index=0,
            attitude_xyzw=here,
            rate_rad_s=ZERO,
            exposure_s=0.1,
            gain=self._sensor.gain,
            settings=settings,
        )
        if helper is not None:
            for rate in _WARM_UP_RATES_RAD_S:
                frame = self._renderer.render(Attitude.identity(), rate)
                detect(frame.image, detection_settings(self._sensor, settings))
            helper.wait()  # what it has compiled is loaded below; what it could not is compiled there
        for rate, predicted in itertools.product(_WARM_UP_RATES_RAD_S, (None, here)):
            self._frame(replace(request, rate_rad_s=rate, predicted_xyzw=predicted))
        self._last = None

    def handle(self, request: FrameRequest | ImageRequest) -> FrameResult | ImageResult | Failure:
        """Do one request; what a setting makes impossible comes back as a failure."""
        try:
            if isinstance(request, ImageRequest):
                return self._image(request)
            return self._frame(request)
        except (EmulatorError, StaridError) as error:
            return Failure(str(error))
        except Exception as error:  # noqa: BLE001 (one frame that fails must not end those after it)
            return Failure(f"picture pipeline: internal error: {one_line(error)}")

    def _frame(self, request: FrameRequest) -> FrameResult:
        begin = time.perf_counter()
        sensor = self._sensor.with_(exposure_s=request.exposure_s, gain=request.gain)
        if sensor.gain != self._renderer.sensor.gain:
            self._renderer = self._renderer.with_sensor(sensor)
        attitude = Attitude(np.array(request.attitude_xyzw))
        sky = SkyObjects.from_dict({**self._setup.sky, **request.faults}) if request.faults else self._sky
        frame = self._renderer.render(
            attitude, request.rate_rad_s, request.index, exposure_s=request.exposure_s, objects=sky
        )
        self._last = frame
        rendered = time.perf_counter()
        if not request.solve:
            return FrameResult(request.index, solved=False, render_s=rendered - begin)
        found = detect(frame.image, detection_settings(sensor, request.settings))
        detected = time.perf_counter()
        identifier, current = self._identifiers.get(self._choice(request.settings))
        solution = self._solve(identifier, found, request)
        solved = time.perf_counter()
        result = self._result(request, sensor, found, solution, (begin, rendered, detected, solved))
        return result if current else replace(result, index_pending=True)

    def _solve(self, identifier: StarIdentifier, found: Detections, request: FrameRequest) -> Solution:
        settings = request.settings
        chosen = slice(0, settings.max_stars_matched if self._setup.algorithm == "geometric" else None)
        xy, flux = found.xy_px[chosen], found.flux[chosen] / request.exposure_s
        sigma = np.sqrt(np.mean(found.xy_sigma_px[chosen] ** 2, axis=1))
        if request.predicted_xyzw is None:
            solution = identifier.identify(xy, flux, sigma)
        else:
            predicted = np.array(request.predicted_xyzw)
            solution = identifier.track(xy, flux, predicted, sigma, window_px=tracking_window(settings))
        if solution.valid and _within_margin(identifier, solution, xy, settings) < settings.min_stars_matched:
            reason = (
                Reason.TOO_FEW_STARS if solution.star_count < settings.min_stars_matched else Reason.RESIDUAL
            )
            return Solution.invalid(reason, mode=solution.mode, elapsed=solution.elapsed)
        return solution

    def _choice(self, settings: SolverSettings) -> IdentifierChoice:
        """What the identifier for the device's own idea of its camera is made for."""
        setup = self._setup
        options: dict[str, Any] = {**setup.identifier}
        options.setdefault("limiting_magnitude", settings.limiting_magnitude)
        if setup.algorithm != "geometric":  # these count the stars of a field, and so need their magnitudes
            options.setdefault("zero_point", 2.5 * math.log10(self._sensor.zero_magnitude_e_s))
        camera = own_camera(self.camera, settings)
        margin = settings.error_margin / 100.0
        return IdentifierChoice(setup.algorithm, camera, margin, tuple(sorted(options.items())))

    def _result(
        self,
        request: FrameRequest,
        sensor: SensorModel,
        found: Detections,
        solution: Solution,
        times: tuple[float, float, float, float],
    ) -> FrameResult:
        begin, rendered, detected, solved = times
        stars = sorted(
            (
                MatchedStar(
                    hip=int(hip),
                    x=float(found.xy_px[row, 0]),
                    y=float(found.xy_px[row, 1]),
                    magnitude=measured_magnitude(float(found.flux[row]), sensor),
                    snr=float(found.flux[row] / found.flux_sigma[row]),
                )
                for row, hip in zip(solution.detection_index, solution.hip, strict=True)
            ),
            key=lambda star: (star.magnitude, star.hip),
        )
        valid = solution.valid
        x, y, z, w = solution.quaternion_xyzw.tolist() if valid else (0.0, 0.0, 0.0, 0.0)
        reason = REASONS[solution.reason]
        if not valid and found.reason and len(found.flux) == 0:
            reason = "detection_failed"
        rate = solution.rate_rad_s
        return FrameResult(
            index=request.index,
            valid=valid,
            reason=reason,
            tracked=solution.mode == "tracking",
            quaternion_xyzw=(x, y, z, w),
            sigma_cross_arcsec=solution.cross_boresight_sigma_arcsec if valid else 0.0,
            sigma_roll_arcsec=solution.roll_sigma_arcsec if valid else 0.0,
            rate_rad_s=None if rate is None else (float(rate[0]), float(rate[1]), float(rate[2])),
            detected=len(found.flux),
            refused=found.rejected,
            matched=solution.star_count,
            stars=tuple(stars[:STARS_SENT]),
            probability_false=solution.probability_false if valid else 1.0,
            rms_px=solution.rms_px if valid else 0.0,
            background_dn=float(found.background),
            noise_dn=float(found.noise),
            render_s=rendered - begin,
            detect_s=detected - rendered,
            identify_s=solved - detected,
        )

    def _image(self, request: ImageRequest) -> ImageResult:
        if self._last is None:
            return ImageResult(0, 0, -1, b"")
        image, bits, frame = self._last.image, self._sensor.bits, self._last.frame_index
        if request.edge == 0:
            height, width = image.shape
            return ImageResult(width, height, frame, eight_bits(image, bits).tobytes())
        return ImageResult(request.edge, request.edge, frame, square_image(image, bits, request.edge))


def _within_margin(
    identifier: StarIdentifier, solution: Solution, xy: NDArray[np.float64], settings: SolverSettings
) -> int:
    """Count the matched stars that lie within the validation margin of their place."""
    icrs = identifier.catalog.vectors[solution.catalog_index]
    places, _ = identifier.camera.project(solution.attitude.to_sensor(icrs))
    off = np.hypot(*(places - xy[solution.detection_index]).T)
    return int(np.count_nonzero(off <= settings.validation_margin))


def detection_settings(sensor: SensorModel, settings: SolverSettings) -> DetectionSettings:
    """Detection as the device's parameters set it."""
    return sensor.detection_settings(
        threshold_sigma=settings.detection_threshold,
        pixel_sigma=settings.star_threshold,
        min_star_pixels=settings.min_star_pixels,
        max_star_pixels=settings.max_star_pixels,
    )


def own_camera(optics: Camera, settings: SolverSettings) -> Camera:
    """Return the camera as the device's parameters describe it; what they do not tell is that of the optics."""
    return Camera(
        optics.width,
        optics.height,
        (settings.focal_length, settings.focal_length * optics.focal_px[1] / optics.focal_px[0]),
        (settings.centroid_x, settings.centroid_y),
        optics.model,
        (settings.k1, settings.k2, settings.p1, settings.p2, optics.distortion[4]),
    )


def tracking_window(settings: SolverSettings) -> float:
    """How far a star may be from its prediction, pixels: the margin, within the windows that are searched and read."""
    return float(min(settings.tracking_margin, settings.search_width / 2.0, settings.window_width / 2.0))


def measured_magnitude(electrons: float, sensor: SensorModel) -> float:
    """Magnitude of a star that gave so many electrons in the exposure."""
    return -2.5 * math.log10(max(electrons, 1.0) / (sensor.zero_magnitude_e_s * sensor.exposure_s))


def eight_bits(image: NDArray[Any], bits: int) -> NDArray[np.uint8]:
    """Return an image of `bits` bits with its eight highest."""
    return (image >> max(0, bits - BYTE_LEVELS)).astype(np.uint8)


def square_image(image: NDArray[Any], bits: int, edge: int) -> bytes:
    """Return an image as a square of `edge` pixels of 8 bit, row by row.

    The frame stands at the top left of a black square of the next power of two, so that its pixel positions hold; a
    smaller one is the mean over squares of pixels, a larger one is refused by the caller's choice of sizes.
    """
    height, width = image.shape
    full = 1 << (max(height, width) - 1).bit_length()
    full = max(full, edge)
    square = np.zeros((full, full), dtype=np.uint8)
    square[:height, :width] = eight_bits(image, bits)
    return mean_over_squares(square, full // edge).tobytes()
