"""The image pipeline: renders images, detects stars and identifies them."""

from __future__ import annotations

import itertools
import math
import subprocess
import time
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from starhil.emulator.errors import EmulatorError, one_line
from starhil.emulator.sensor.dark_map import DarkMap, measure_dark_map
from starhil.emulator.sensor.model import SensorModel
from starhil.emulator.sensor.overexposure import Afterimage
from starhil.emulator.sensor.pipeline.binning import mean_over_squares
from starhil.emulator.sensor.pipeline.bodies import bodies_in_field, near_any, stars_seen, with_bodies
from starhil.emulator.sensor.pipeline.image_source import ImageSource, open_images, used_bits
from starhil.emulator.sensor.pipeline.jpg import compress_image
from starhil.emulator.sensor.pipeline.messages import (
    Failure,
    FrameRequest,
    FrameResult,
    ImageRequest,
    ImageResult,
    IndexReady,
    IndexRequest,
    JpgRequest,
    JpgResult,
    MatchedStar,
    PipelineReady,
    PipelineSetup,
    Preview,
    SolverSettings,
    as_rows,
    as_triple,
    camera_constants,
)
from starhil.emulator.sensor.pipeline.photometry import MeasuredPhotometry, measure_photometry
from starhil.emulator.sensor.pipeline.preview import make_preview
from starhil.emulator.sensor.pipeline.star_identifiers import StarIdentifiers, StarIdentifierSetup
from starhil.emulator.sensor.renderer import Frame, Renderer, frame_without_truth
from starhil.emulator.sensor.sky.objects import SkyObjects
from starhil.emulator.sensor.sky.view import Sky
from starhil.emulator.truth.source import ZERO_RATE, TruthState
from starid.arithmetic.arrays import Array, Mask
from starid.arithmetic.elementary import log10
from starid.arithmetic.matrices import length, lengths
from starid.attitude import ARCSEC_PER_RAD, Attitude
from starid.camera import Camera
from starid.catalog import StarCatalog, load_catalog
from starid.catalog.aberration import aberrated
from starid.errors import StaridError
from starid.identification.error_risk import flagged, largest_across_rad, rejected
from starid.identification.geometric.identifier import Effort
from starid.identification.geometric.index_choice import pixels_per_radian
from starid.identification.geometric.pattern_index import resolved_stars
from starid.identification.lens_errors import with_lens_errors
from starid.identification.options import GeometricOptions
from starid.identification.predicted_stars import Prediction, expected_places, solve_with_prediction
from starid.identification.solution import Reason, Solution
from starid.identification.star_identifier import StarIdentifier
from starid.imaging.detection import Detections, DetectionSettings, detect
from starid.imaging.star_windows import detect_near

STARS_SENT: Final = 16
"""Number of identified stars returned to the device; the brightest ones."""

DOWNLOAD_BITS: Final = 8
"""Bits per pixel of an image for download."""

_TRACKED_SIGMA: Final = 3.0
"""Detection threshold near the predicted places of stars."""

_TRACKED_LIMITS: Final = 4
"""Number of lists of stars to look for that are kept, by limiting magnitude."""

_LONGEST_STILL_PX: Final = 1.0
"""Longest trail of a star that is taken for a spot."""

_MAX_FALSE_PROBABILITY: Final = Effort().max_false_probability_tracking

_WARM_UP_EXPOSURE_S: Final = 1.0
"""Exposure in which a dim sensor too sees enough stars to follow their trails, seconds."""

_WARM_UP_RATES_RAD_S: Final = ((1e-4, 0.0, 0.0), (3e-3, 0.0, 0.0))
"""Rates at which stars in this exposure are round, or leave trails of a few pixels."""


def make_pipeline(
    setup: PipelineSetup, helper: subprocess.Popen[bytes] | None = None
) -> tuple[Pipeline, PipelineReady] | Failure:
    """Make a pipeline and warm it up, with a `helper` as in `Pipeline.warm_up`; on failure, return the reason in one line."""
    begin = time.perf_counter()
    try:
        pipeline = Pipeline(setup)
        images = open_images(setup.images, pipeline.camera)
        if images is not None:
            images.image(0)  # an image of the wrong size fails before the long start
        pipeline.warm_up(helper)
        pipeline.images = images
    except (EmulatorError, StaridError) as error:
        return Failure(str(error))
    except Exception as error:  # noqa: BLE001 (reported in one line instead of the worker's traceback)
        return Failure(f"pipeline: internal error: {one_line(error)}")
    warm = PipelineReady(pipeline.camera.to_dict(), len(pipeline.catalog), time.perf_counter() - begin)
    return pipeline, warm


@dataclass(frozen=True)
class _Exposure:
    """An image, its number of bits, the number of its exposure, and the bodies in its field.

    A rendered image also has its truth: the frame and the objects of the sky.
    """

    image: NDArray[Any]
    bits: int
    index: int
    in_field: tuple[str, ...] = ()
    frame: Frame | None = None
    objects: SkyObjects = field(default_factory=SkyObjects)

    def false_stars(self, xy_px: Array) -> Mask:
        """Which positions (n, 2) are those of false stars; none if the image was not rendered."""
        if self.frame is None or self.frame.objects is None:
            return np.zeros(len(xy_px), dtype=np.bool_)
        return near_any(xy_px, self.frame.objects.false_xy_px)


class Pipeline:
    """Renderer, detector and star identifier of a run, with the state they keep between frames."""

    def __init__(self, setup: PipelineSetup) -> None:
        self._setup = setup
        self.camera = Camera.from_dict(setup.camera)
        self.catalog = load_catalog(setup.catalog_path or None, setup.epoch)
        self._sensor = SensorModel().with_(**setup.sensor)
        self._renderer = Renderer(self.camera, self.catalog, self._sensor, setup.seed)
        self._identifiers = StarIdentifiers(
            lambda wanted: wanted.make(self.catalog), in_background=setup.build_in_background
        )
        self._sky = Sky(setup.sky)
        self._last: _Exposure | None = None
        self.images: ImageSource | None = None
        """Source of images; None: they are rendered."""
        self._afterimage: tuple[int, Afterimage | None] = (0, None)
        """The charge left by exposures, and the start of the pipeline since which it has been left."""
        self._dark: DarkMap | None = None
        self._tracked: dict[float, StarCatalog] = {}
        self._calibration = None if setup.calibration is None else np.array(setup.calibration)
        """Covariance (9, 9) of the calibrated camera's parameters; None: they are exact."""

    def warm_up(self, helper: subprocess.Popen[bytes] | None = None) -> None:
        """Render and solve frames, lost in space and tracking, so that every kernel is compiled.

        Compiling a kernel during a run would interrupt frames for seconds, so some frames here have star
        trails. A `helper` that compiles the star identifier is waited for.
        """
        settings = replace(self._setup.settings, **camera_constants(self.camera.to_dict()))
        attitude = Attitude.identity()
        request = FrameRequest(
            index=0,
            truth=TruthState(attitude, ZERO_RATE),
            exposure_s=_WARM_UP_EXPOSURE_S,
            gain=self._sensor.gain,
            settings=settings,
            preview=self._setup.previews,
        )
        if helper is not None:
            for rate in _WARM_UP_RATES_RAD_S:
                frame = self._renderer.render(Attitude.identity(), rate, exposure_s=_WARM_UP_EXPOSURE_S)
                detect(frame.image, detection_settings(self._sensor.detection_settings(), settings))
            helper.wait()  # kernels it compiled are loaded below; any others are compiled there
        for rate, predicted in itertools.product(_WARM_UP_RATES_RAD_S, (None, attitude)):
            turning = TruthState(attitude, np.array(rate))
            self._process_frame(replace(request, truth=turning, predicted=predicted))
        self._last = None

    def handle(
        self, request: FrameRequest | ImageRequest | JpgRequest | IndexRequest
    ) -> FrameResult | ImageResult | JpgResult | IndexReady | Failure:
        """Process a request; return a failure if the settings make it impossible."""
        try:
            if isinstance(request, IndexRequest):
                self._identifiers.build(self._identifier_setup(request))
                if request.rehearsal is not None:
                    self._rehearse(request.rehearsal)
                return IndexReady()
            if isinstance(request, ImageRequest):
                return self._scaled_image(request)
            if isinstance(request, JpgRequest):
                return compress_image(request)
            return self._process_frame(request)
        except (EmulatorError, StaridError) as error:
            return Failure(str(error))
        except Exception as error:  # noqa: BLE001 (one frame that fails must not end those after it)
            return Failure(f"pipeline: internal error: {one_line(error)}")

    def _rehearse(self, request: FrameRequest) -> None:
        """Take a frame that does not count.

        Only `geometric` keeps nothing from frame to frame, so that only it identifies stars in them.
        """
        if self.images is not None:
            return
        last = self._last
        if self._setup.algorithm == "geometric":
            for predicted in (None, request.truth.attitude):
                self._process_frame(replace(request, predicted=predicted))
        else:
            self.detections(request)
        self._last = last

    def _process_frame(self, request: FrameRequest) -> FrameResult:
        begin = time.perf_counter()
        sensor = self._sensor.with_(exposure_s=request.exposure_s, gain=request.gain)
        if sensor.gain != self._renderer.sensor.gain:
            self._renderer = self._renderer.with_sensor(sensor)
        exposure = self._last = self._expose(request)
        rendered = time.perf_counter()
        if not request.solve:
            preview = self._preview(exposure, sensor) if request.preview else None
            return FrameResult(request.index, solved=False, render_s=rendered - begin, preview=preview)
        identifier, current = self._identifiers.get(self._identifier_setup(request))
        windows = self._detect_predicted(exposure, request, sensor)
        detections = self._detect(exposure, request, sensor) if windows is None else windows
        detected = time.perf_counter()
        detections, solution = self._solve_or_follow(exposure, request, sensor, identifier, detections)
        if windows is not None and not solution.valid:
            whole = self._detect(exposure, request, sensor)
            detected = time.perf_counter()
            detections, solution = self._solve_or_follow(exposure, request, sensor, identifier, whole)
        solved = time.perf_counter()
        times = (begin, rendered, detected, solved)
        result = self._frame_result(request, sensor, detections, solution, identifier, times)
        if exposure.frame is not None:
            stars = exposure.frame.stars
            seen = stars_seen(stars.xy_px[stars.visible], detections.xy_px) if exposure.in_field else 0
            enough = seen >= request.settings.min_stars_matched
            result = with_bodies(result, exposure.in_field, enough_stars=enough)
            if solution.features is not None:
                false = exposure.false_stars(detections.xy_px)
                removed = list(solution.features.removed_index)
                counts = int(np.count_nonzero(false)), int(np.count_nonzero(false[removed]))
                result = replace(result, false_detected=counts[0], false_removed=counts[1])
        if request.preview:
            result = replace(result, preview=self._preview(exposure, sensor, detections, solution))
        return result if current else replace(result, index_pending=True)

    def detections(self, request: FrameRequest) -> tuple[Detections, Mask]:
        """Take the image of a request and return its detections, and which of them are false stars."""
        sensor = self._sensor.with_(exposure_s=request.exposure_s, gain=request.gain)
        exposure = self._expose(request)
        found = self._detect(exposure, request, sensor)
        return found, exposure.false_stars(found.xy_px)

    def identifier(self, request: FrameRequest) -> StarIdentifier:
        return self._identifiers.build(self._identifier_setup(request))

    def solution(
        self, detections: Detections, request: FrameRequest, identifier: StarIdentifier | None = None
    ) -> Solution:
        """Identify detections with the parameters of a request, by default with the identifier of the device."""
        return self._solve(identifier or self.identifier(request), detections, request)

    def _detect(self, exposure: _Exposure, request: FrameRequest, sensor: SensorModel) -> Detections:
        return detect(*self._detection(exposure, request, sensor))

    def _detection(
        self, exposure: _Exposure, request: FrameRequest, sensor: SensorModel
    ) -> tuple[NDArray[Any], DetectionSettings]:
        """Return the image in which the unit detects stars, and its settings."""
        if self.images is None:
            image, known = self._without_dark(exposure.image, request), sensor.detection_settings()
        else:
            image, known = exposure.image, DetectionSettings()
        return image, detection_settings(known, request.settings)

    def _preview(
        self,
        exposure: _Exposure,
        sensor: SensorModel,
        detections: Detections | None = None,
        solution: Solution | None = None,
    ) -> Preview:
        """Return the preview of an image; without truth if the image was not rendered."""
        frame = exposure.frame or frame_without_truth(exposure.image, exposure.index)
        return make_preview(frame, self.camera, sensor, exposure.objects, detections, solution)

    def _expose(self, request: FrameRequest) -> _Exposure:
        """Take the next image from its source, or render it."""
        if self.images is not None:
            image = self.images.image(request.index)
            return _Exposure(image, used_bits(image), request.index)
        truth, orbit = request.truth, request.truth.orbit
        attitude = Attitude(truth.attitude.quaternion_xyzw)  # read-only again, which pickling does not keep
        position, velocity = (None, None) if orbit is None else (orbit.position_m, orbit.velocity_m_s)
        sky = self._sky.view(truth.unix_s, position, velocity, request.faults)
        objects = sky.objects
        if request.particles_s > 0.0:
            objects = replace(objects, cosmic_rays_s=objects.cosmic_rays_s + request.particles_s)
        frame = self._renderer.render(
            attitude,
            truth.rate_rad_s,
            request.index,
            exposure_s=request.exposure_s,
            temperature_c=request.temperature_c,
            objects=objects,
            observer=sky.observer,
            satellites=sky.satellites,
            afterimage=self._afterimage_for(request),
            begin_s=request.begin_s or 0.0,
        )
        in_field = bodies_in_field(objects, attitude, self.camera)
        return _Exposure(frame.image, self._sensor.bits, frame.frame_index, in_field, frame, objects)

    def _afterimage_for(self, request: FrameRequest) -> Afterimage | None:
        """Return the afterimage of the exposures since the pipeline was started; None for an image by itself, or without traps."""
        sensor = self._sensor
        if request.begin_s is None or sensor.persistence_share == 0.0:
            return None
        starts, afterimage = self._afterimage
        if afterimage is None or starts != request.pipeline_starts:
            capacity_e = sensor.persistence_share * sensor.full_well_e
            afterimage = Afterimage(sensor.full_well_e, capacity_e, sensor.persistence_s)
            self._afterimage = request.pipeline_starts, afterimage
        return afterimage

    def _without_dark(self, image: NDArray[Any], request: FrameRequest) -> NDArray[Any]:
        """Subtract the unit's dark frame, scaled to the exposure, gain and temperature of the image."""
        frames = self._setup.device.dark_frames
        if frames == 0:
            return image
        if self._dark is None:
            camera = self.camera
            self._dark = measure_dark_map(self._sensor, camera.height, camera.width, frames, self._setup.seed)
        temperature = self._sensor.temperature_c if request.temperature_c is None else request.temperature_c
        return self._dark.subtracted(image, request.exposure_s, request.gain, temperature)

    def _solve(self, identifier: StarIdentifier, detections: Detections, request: FrameRequest) -> Solution:
        settings = request.settings
        brightest = slice(0, settings.max_stars_matched if self._setup.algorithm == "geometric" else None)
        xy, flux = detections.xy_px[brightest], detections.flux[brightest] / request.exposure_s
        errors = detections.position_errors[brightest]
        if request.predicted is None:
            solution = identifier.identify(xy, flux, errors, observer_velocity=request.observer_velocity)
        else:
            solution = identifier.track(
                xy,
                flux,
                np.array(request.predicted.quaternion_xyzw),
                errors,
                window_px=_window_px(settings),
                observer_velocity=request.observer_velocity,
            )
        if not solution.valid or (solution.features is not None and not solution.features.refined):
            return solution
        offsets = _offsets(identifier, solution, xy, request)
        within = lengths(offsets) <= settings.validation_margin
        if np.count_nonzero(within) < settings.min_stars_matched:
            reason = (
                Reason.TOO_FEW_STARS if solution.star_count < settings.min_stars_matched else Reason.RESIDUAL
            )
            return rejected(solution, reason)
        if self._calibration is not None:
            camera, used = calibrated_camera(self.camera, settings), solution.detection_index
            certain = with_lens_errors(solution, camera, self._calibration, xy[used], errors[used], offsets)
            solution = flagged(certain, self._setup.device.largest_error_deg)
        return solution

    def _solve_or_follow(
        self,
        exposure: _Exposure,
        request: FrameRequest,
        sensor: SensorModel,
        identifier: StarIdentifier,
        detections: Detections,
    ) -> tuple[Detections, Solution]:
        """Identify detections; if that gives no attitude, or one that is less certain than the prediction, combine stars with it."""
        solution = self._solve(identifier, detections, request)
        if solution.valid and not _less_certain(solution, request):
            return detections, solution
        return self._follow(exposure, request, sensor, identifier, detections, solution)

    def _follow(
        self,
        exposure: _Exposure,
        request: FrameRequest,
        sensor: SensorModel,
        identifier: StarIdentifier,
        detections: Detections,
        failed: Solution,
    ) -> tuple[Detections, Solution]:
        """Combine a prediction with the few and faint stars where it expects them; return detections and solution.

        Without agreement, the given ones are returned: an attitude that is less certain than the prediction is then invalid.
        """
        covariance, least = request.prediction_covariance, self._setup.device.tracking_stars
        predicted = self._window_centre(request)
        if covariance is None or least == 0 or predicted is None or self._leaves_trails(request):
            return detections, failed
        settings, camera = request.settings, calibrated_camera(self.camera, request.settings)
        stars = self._tracked_stars(
            settings.limiting_magnitude + 2.5 * log10(settings.detection_threshold / _TRACKED_SIGMA)
        )
        places = self._predicted_places(predicted, request, stars)
        if len(places) < least:
            return detections, failed
        image, usual = self._detection(exposure, request, sensor)
        faint = replace(
            usual,
            threshold_sigma=min(_TRACKED_SIGMA, usual.threshold_sigma),
            min_star_pixels=0,
            psf_sigma_px=sensor.mean_psf_sigma_px,
        )
        in_windows, rivals, searched = detect_near(image, places, _window_px(settings), faint)
        solution = solve_with_prediction(
            camera, stars, in_windows, Prediction(predicted, covariance, request.prediction_freedom),
            2.5 * log10(sensor.zero_magnitude_e_s * sensor.exposure_s), _MAX_FALSE_PROBABILITY, self._setup.device.largest_error_deg,
            wrong_predictions=self._setup.device.wrong_predictions, rivals=rivals, searched=searched,
            observer_velocity=request.observer_velocity, camera_covariance=self._calibration,
        )  # fmt: skip
        if not solution.valid or solution.star_count < least:
            return detections, rejected(failed, Reason.PREDICTION_LOST) if failed.valid else failed
        rows = identifier.catalog.index_of(solution.hip).astype(np.int64)
        return in_windows, replace(solution, catalog_index=rows)

    def _detect_predicted(
        self, exposure: _Exposure, request: FrameRequest, sensor: SensorModel
    ) -> Detections | None:
        """Detect the brightest predicted stars in windows; None if the unit does not, or if stars leave trails."""
        predicted = self._window_centre(request)
        if not self._setup.device.tracking_windows or predicted is None or self._leaves_trails(request):
            return None
        settings = request.settings
        stars = self._tracked_stars(settings.limiting_magnitude)
        places = self._predicted_places(predicted, request, stars)
        image, known = self._detection(exposure, request, sensor)
        return detect_near(image, places[: settings.max_stars_matched], _window_px(settings), known).found

    def _leaves_trails(self, request: FrameRequest) -> bool:
        """Whether stars leave trails at the predicted rate: only the whole image shows how they run."""
        rate = request.predicted_rate_rad_s or (0.0, 0.0, 0.0)
        trail_px = length(np.array(rate)) * request.exposure_s * max(self.camera.focal_px)
        return trail_px > _LONGEST_STILL_PX

    def _window_centre(self, request: FrameRequest) -> Attitude | None:
        """Return the prediction if windows can be laid: not with a damaged catalogue, whose list of stars is another one."""
        if self._setup.algorithm != "geometric" or self.images is not None or request.upsets:
            return None
        predicted = request.predicted
        return None if predicted is None else Attitude(np.array(predicted.quaternion_xyzw))

    def _predicted_places(self, predicted: Attitude, request: FrameRequest, stars: StarCatalog) -> Array:
        """Return where a prediction shows stars, brightest first; pixels (m, 2)."""
        camera = calibrated_camera(self.camera, request.settings)
        return expected_places(camera, stars, predicted, request.observer_velocity)[1]

    def _tracked_stars(self, limiting_magnitude: float) -> StarCatalog:
        """Return the stars to a limit, as the camera resolves them."""
        if limiting_magnitude not in self._tracked:
            blend_rad = GeometricOptions().blend_px / pixels_per_radian(self.camera)
            if len(self._tracked) >= _TRACKED_LIMITS:
                self._tracked.clear()
            self._tracked[limiting_magnitude] = resolved_stars(self.catalog, limiting_magnitude, blend_rad)
        return self._tracked[limiting_magnitude]

    def _identifier_setup(self, request: FrameRequest | IndexRequest) -> StarIdentifierSetup:
        """Return the setup of the star identifier for the parameters and the calibrated camera."""
        setup, settings = self._setup, request.settings
        options: dict[str, Any] = {**setup.identifier}
        options["limiting_magnitude"] = settings.limiting_magnitude
        options["largest_error_deg"] = self._setup.device.largest_error_deg
        if setup.algorithm != "geometric":  # LSI and RSI count the stars above a magnitude
            options.setdefault("zero_point", 2.5 * log10(self._sensor.zero_magnitude_e_s))
            options.setdefault("colour_term", self._sensor.colour_term)
            if "detected_limit" not in options:
                found = self._measured_photometry
                options |= {"detected_limit": found.limit} | {"magnitude_sigma": found.sigma, **options}
        camera = calibrated_camera(self.camera, settings)
        margin = settings.error_margin / 100.0
        return StarIdentifierSetup(
            setup.algorithm, camera, margin, tuple(sorted(options.items())), request.upsets
        )

    @cached_property
    def _measured_photometry(self) -> MeasuredPhotometry:
        """The limit of the detector with the exposure of the profile."""
        exposure_s = self._setup.exposure_s
        known = self._sensor.with_(exposure_s=exposure_s).detection_settings()
        settings = detection_settings(known, self._setup.settings)

        def expose(attitude: Attitude, index: int) -> Frame:
            return self._renderer.render(attitude, ZERO_RATE, index, exposure_s=exposure_s)

        zero_e = self._sensor.zero_magnitude_e_s * exposure_s
        return measure_photometry(expose, lambda frame: detect(frame.image, settings), zero_e)

    def _frame_result(
        self,
        request: FrameRequest,
        sensor: SensorModel,
        detections: Detections,
        solution: Solution,
        identifier: StarIdentifier,
        times: tuple[float, float, float, float],
    ) -> FrameResult:
        """Return the result of a frame; the vectors of its stars are by the camera of its quaternion."""
        begin, rendered, detected, solved = times
        zero_e = sensor.zero_magnitude_e_s * sensor.exposure_s
        camera = _camera_of(solution, identifier)
        measured = camera.back_project(detections.xy_px[solution.detection_index])
        modelled = identifier.catalog.vectors[solution.catalog_index]
        stars = sorted(
            (
                MatchedStar(
                    hip=int(hip),
                    x=float(detections.xy_px[row, 0]),
                    y=float(detections.xy_px[row, 1]),
                    magnitude=-2.5 * log10(max(float(detections.flux[row]), 1.0) / zero_e),
                    snr=float(detections.flux[row] / detections.flux_sigma[row]),
                    vector=as_triple(direction),
                    icrs=as_triple(icrs),
                )
                for row, hip, direction, icrs in zip(
                    solution.detection_index, solution.hip, measured, modelled, strict=True
                )
            ),
            key=lambda star: (star.magnitude, star.hip),
        )
        valid = solution.valid
        x, y, z, w = solution.quaternion_xyzw.tolist() if valid else (0.0, 0.0, 0.0, 0.0)
        reason = solution.reason.value if detections.searchable else "detection_failed"
        rate = solution.rate_rad_s
        return FrameResult(
            index=request.index,
            valid=valid,
            reason=reason,
            tracked=solution.mode == "tracking",
            quaternion_xyzw=(x, y, z, w),
            sigma_cross_arcsec=largest_across_rad(solution.covariance) * ARCSEC_PER_RAD if valid else 0.0,
            sigma_roll_arcsec=solution.roll_sigma_arcsec if valid else 0.0,
            covariance_rad2=as_rows(solution.covariance) if valid else None,
            freedom=solution.freedom if valid else math.inf,
            rate_rad_s=None if rate is None else (float(rate[0]), float(rate[1]), float(rate[2])),
            detected=len(detections.flux),
            refused=detections.rejected,
            matched=solution.star_count,
            stars=tuple(stars[:STARS_SENT]),
            probability_false=solution.probability_false if valid else 1.0,
            rms_px=solution.rms_px if valid and solution.star_count else 0.0,
            features=solution.features,
            background_dn=float(detections.background),
            noise_dn=float(detections.noise),
            render_s=rendered - begin,
            detect_s=detected - rendered,
            identify_s=solved - detected,
        )

    def _scaled_image(self, request: ImageRequest) -> ImageResult:
        if self._last is None:
            return ImageResult(0, 0, -1, b"")
        image, bits, frame = self._last.image, self._last.bits, self._last.index
        if request.edge == 0:
            height, width = image.shape
            return ImageResult(width, height, frame, eight_bits(image, bits).tobytes())
        return ImageResult(request.edge, request.edge, frame, square_image(image, bits, request.edge))


def _offsets(identifier: StarIdentifier, solution: Solution, xy: Array, request: FrameRequest) -> Array:
    """Return the distances (m, 2) of the matched stars from their expected positions, pixels."""
    icrs = identifier.catalog.vectors[solution.catalog_index]
    if request.observer_velocity is not None:
        icrs = aberrated(icrs, request.observer_velocity)
    expected_xy, _ = _camera_of(solution, identifier).project(solution.attitude.to_sensor(icrs))
    return np.asarray(xy[solution.detection_index] - expected_xy)


def _camera_of(solution: Solution, identifier: StarIdentifier) -> Camera:
    """Return the camera with which an attitude was found: the calibrated one, or that one refined by the solution."""
    return identifier.camera if solution.camera is None else solution.camera


def _less_certain(solution: Solution, request: FrameRequest) -> bool:
    """Whether a valid solution is less certain than the prediction, about some axis."""
    expected = request.prediction_covariance
    return expected is not None and bool(np.any(np.diag(solution.covariance) > np.diag(expected)))


def _window_px(settings: SolverSettings) -> float:
    """Return the largest distance of a tracked star from its prediction, pixels."""
    return float(min(settings.tracking_margin, settings.search_width / 2.0, settings.window_width / 2.0))


def detection_settings(known: DetectionSettings, settings: SolverSettings) -> DetectionSettings:
    """Return the known detection settings, with the thresholds in the parameters of the device."""
    return replace(
        known,
        threshold_sigma=settings.detection_threshold,
        pixel_sigma=settings.star_threshold,
        min_star_pixels=settings.min_star_pixels,
        max_star_pixels=settings.max_star_pixels,
    )


def calibrated_camera(optics: Camera, settings: SolverSettings) -> Camera:
    """Return the camera as calibrated in the device parameters; other constants come from the optics."""
    return Camera(
        optics.width,
        optics.height,
        (settings.focal_length, settings.focal_length * optics.focal_px[1] / optics.focal_px[0]),
        (settings.centroid_x, settings.centroid_y),
        optics.model,
        (settings.k1, settings.k2, settings.p1, settings.p2, optics.distortion[4]),
    )


def eight_bits(image: NDArray[Any], bits: int) -> NDArray[np.uint8]:
    """Reduce an image of `bits` bits to its eight most significant."""
    return (image >> max(0, bits - DOWNLOAD_BITS)).astype(np.uint8)


def square_image(image: NDArray[Any], bits: int, edge: int) -> bytes:
    """Scale an image to a square of `edge` pixels at 8 bits, row by row.

    The image is padded with black at the right and bottom to a square of the next power of two, which keeps
    its pixel positions, and then averaged over squares of pixels. `edge` is one of `IMAGE_EDGES`.
    """
    height, width = image.shape
    full = 1 << (max(height, width) - 1).bit_length()
    full = max(full, edge)
    square = np.zeros((full, full), dtype=np.uint8)
    square[:height, :width] = eight_bits(image, bits)
    return mean_over_squares(square, full // edge).tobytes()
