"""Compares star identification solvers on the same scenes, and with the least-squares bound."""

from __future__ import annotations

import datetime as dt
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np

from starid.arithmetic.arrays import Array
from starid.attitude import Attitude
from starid.camera import DEFAULT_CAMERA, Camera
from starid.catalog import StarCatalog, load_catalog
from starid.errors import StaridError
from starid.identification.geometric.pattern_index import resolved_stars
from starid.lab.leaderboard.peers import (
    InvalidSolverError,
    NotInstalledError,
    Reply,
    Solver,
    check_name,
    make_solver,
    resident_bytes,
    version_of,
)
from starid.lab.leaderboard.scenes import Scene, SceneMaker, SceneSettings, read_scenes

_GROUPS: Final = read_scenes()

ROWS: Final = {name: settings for group in _GROUPS.values() for name, settings in group.items()}
"""Row of the report → scene, as in `scenes.toml`."""

PAPERS: Final = tuple(_GROUPS["papers"])
"""Scenes of the sensors that the papers of the published algorithms simulate."""

WINDOW_SIGMAS: Final = 20.0 / 3.0
"""Largest distance of a star from its predicted position, as given to solvers that track, in standard deviations."""

STANDARD: Final = tuple(_GROUPS["standard"])
"""Rows of the published comparison."""

LEADERBOARD: Final = (*STANDARD, *_GROUPS["fields_and_tracking"])
"""Rows of the published comparison, other fields, a dense one, and a few stars in tracking."""

WRONG_ARCSEC: Final = 360.0
WRONG_ROLL_ARCSEC: Final = 3600.0
"""A valid attitude whose boresight or roll is off the truth by more than these is wrong. It is
ill-conditioned if the least-squares attitude of the true matches is within these of it: two or three stars
close together determine no attitude better."""

PEER_LIMIT_V: Final = 5.5
"""Lowest magnitude limit of the databases of third-party solvers and published algorithms; scenes with fainter
stars have their own limit."""

_BLEND_PX: Final = 2.0
_DEEPER_V: Final = 0.5
_FLOOR_STEPS: Final = 3


@dataclass
class Tally:
    """Results of one solver in one row, frame by frame; ill-conditioned answers are counted as wrong too."""

    row: str
    solver: str
    frames: int = 0
    valid: int = 0
    wrong: int = 0
    ill_conditioned: int = 0
    boresight: list[float] = field(default_factory=list)
    roll: list[float] = field(default_factory=list)
    floor_boresight: list[float] = field(default_factory=list)
    floor_roll: list[float] = field(default_factory=list)
    squared: list[float] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)
    cpu_seconds: list[float] = field(default_factory=list)

    def add(self, scene: Scene, floor: Attitude | None, reply: Reply) -> None:
        """Add the result of one frame; `floor` is None if there is no true attitude."""
        self.frames += 1
        self.seconds.append(reply.seconds)
        self.cpu_seconds.append(reply.cpu_seconds)
        if reply.matrix is None:
            return
        self.valid += 1
        answer = Attitude.from_matrix(_orthonormal(reply.matrix))
        if floor is None or _is_off(answer, scene.attitude):
            self.wrong += 1
            if floor is None or _is_off(answer, floor):
                return
            self.ill_conditioned += 1
        error = answer.error_to(scene.attitude)
        bound = floor.error_to(scene.attitude)
        self.boresight.append(error.cross_boresight_arcsec)
        self.roll.append(error.roll_arcsec)
        self.floor_boresight.append(bound.cross_boresight_arcsec)
        self.floor_roll.append(bound.roll_arcsec)
        if reply.covariance is not None:
            e = error.rotation_vector_rad
            self.squared.append(float(e @ np.linalg.solve(reply.covariance, e)) / 3.0)

    def report(self) -> dict[str, Any]:
        """Return the figures as plain values; None if there are no data."""
        milliseconds, cpu = 1e3 * np.array(self.seconds), 1e3 * np.array(self.cpu_seconds)
        boresight, roll = _median(self.boresight), _median(self.roll)
        return {
            "row": self.row,
            "solver": self.solver,
            "frames": self.frames,
            "valid_pct": 100.0 * self.valid / max(self.frames, 1),
            "wrong": self.wrong,
            "boresight_median_arcsec": boresight,
            "floor_ratio": _ratio(boresight, _median(self.floor_boresight)),
            "median_ms": float(np.median(milliseconds)) if self.frames else None,
            "p99_ms": float(np.percentile(milliseconds, 99.0)) if self.frames else None,
            "cpu_median_ms": float(np.median(cpu)) if self.frames else None,
            "cpu_p99_ms": float(np.percentile(cpu, 99.0)) if self.frames else None,
            "roll_median_arcsec": roll,
            "roll_floor_ratio": _ratio(roll, _median(self.floor_roll)),
            "floor_arcsec": _median(self.floor_boresight),
            "normalised_squared_error": float(np.mean(self.squared)) if self.squared else None,
            "ill_conditioned": self.ill_conditioned,
            "sky": ROWS[self.row].sky,
        }


def run(
    frames: int,
    seed: int,
    *,
    peers: Sequence[str] = (),
    own: Sequence[str] = ("geometric",),
    rows: Sequence[str] = STANDARD,
    camera: Camera = DEFAULT_CAMERA,
    budget_s: float = 120.0,
    raw: bool = False,
    progress: Callable[[str], None] = lambda _row: None,
) -> dict[str, Any]:
    """Run all solvers on the same scenes.

    Parameters
    ----------
    frames : int
        Scenes per row.
    seed : int
        Seed of the scenes; each row restarts with it.
    peers, own : sequence of str
        Solvers; one that is not installed is reported as skipped.
    rows : sequence of str
        Keys of `ROWS`.
    camera : Camera
        Pinhole camera without distortion.
    budget_s : float
        Processor time per row after which a solver skips the rest of the row; its `frames` is the number completed.
    raw : bool
        Whether published algorithms give their answers without verification.
    progress : callable, optional
        Receives the name of each row.

    Returns
    -------
    dict
        `rows` (list of `Tally.report`), `solvers` (what each takes for each field: database, time to build or
        load it, growth of resident memory), `skipped`, `versions`, `seed`, `frames` and `date`.
    """
    if frames < 1:
        raise StaridError(f"--frames {frames}: must be at least 1")
    for row in rows:
        if row not in ROWS:
            raise StaridError(f"--row {row!r}: must be one of {'; '.join(ROWS)}")
    names = list(dict.fromkeys([*own, *peers]))
    for name in names:
        check_name(name)
    tallies: list[Tally] = []
    made: list[dict[str, Any]] = []
    skipped: dict[str, str] = {}
    # rows of one field together, so that only its solvers are held at a time; the table keeps its order
    for (seen, limit), members in _by_field(rows, camera).items():
        field_of = _Field(seen, limit)
        field_of.add(names, made, skipped, raw=raw)
        for row in members:
            progress(row)
            tallies += _run_row(row, frames, seed, field_of, budget_s)
    tallies.sort(key=lambda tally: list(rows).index(tally.row))
    return {
        "date": dt.datetime.now(dt.UTC).date().isoformat(),
        "frames": frames,
        "seed": seed,
        "rows": [tally.report() for tally in tallies],
        "solvers": made,
        "skipped": skipped,
        "versions": {name: version_of(name) for name in dict.fromkeys(tally.solver for tally in tallies)},
    }


def _by_field(rows: Sequence[str], camera: Camera) -> dict[tuple[Camera, float], list[str]]:
    """Rows by their camera and the limit of the databases for it."""
    fields: dict[tuple[Camera, float], list[str]] = {}
    for row in rows:
        settings = ROWS[row]
        side, limit = settings.side_px, settings.limiting_magnitude
        width = settings.field_deg or camera.fov_deg
        seen = Camera.from_fov(width, side or camera.width, side or camera.height)
        if side is None and math.isclose(width, camera.fov_deg):
            seen, limit = camera, max(limit, PEER_LIMIT_V)
        fields.setdefault((seen, limit), []).append(row)
    return fields


class _Field:
    """A camera, the sky of its scenes, and the solvers for it.

    Parameters
    ----------
    camera : Camera
        Pinhole without distortion.
    limit : float
        Faintest V of the databases.
    """

    def __init__(self, camera: Camera, limit: float) -> None:
        stars = resolved_stars(load_catalog(), limit + _DEEPER_V, _BLEND_PX * camera.pixel_scale_rad)
        self.maker = SceneMaker(camera, stars)
        self.known = stars.brighter_than(limit)
        self.solvers: dict[str, Solver] = {}

    def add(
        self, names: Sequence[str], made: list[dict[str, Any]], skipped: dict[str, str], *, raw: bool
    ) -> None:
        """Make solvers; append their costs to `made`, and the reasons why others are skipped to `skipped`."""
        camera = self.maker.camera
        warm = self.maker.scene(SceneSettings(float(self.known.v[-1]), 0.5), np.random.default_rng(1))
        for name in names:
            before, begin = resident_bytes(), time.perf_counter()
            try:
                solver = make_solver(name, camera, self.known, raw=raw)
            except NotInstalledError as error:
                skipped[name] = str(error)
                continue
            except InvalidSolverError:
                raise
            except StaridError as error:
                skipped[f"{name}, {camera.fov_deg:.0f}°"] = str(error)
                continue
            seconds = time.perf_counter() - begin
            solver.solve(warm)
            self.solvers[name] = solver
            size = solver.database_bytes
            made.append(
                {
                    "solver": name,
                    "field_deg": round(camera.fov_deg, 3),
                    "limit_v": float(self.known.v[-1]),
                    "database_kb": None if size is None else 1e-3 * size,
                    "build_s": seconds if solver.build_seconds is None else solver.build_seconds,
                    "memory_mb": 1e-6 * max(resident_bytes() - before, 0),
                }
            )


def _run_row(row: str, frames: int, seed: int, field_of: _Field, budget_s: float) -> list[Tally]:
    settings, maker, solvers = ROWS[row], field_of.maker, field_of.solvers
    tallies = {name: Tally(row, name) for name in solvers}
    spent = dict.fromkeys(solvers, 0.0)
    warm = maker.scene(settings, np.random.default_rng([seed, 1]))
    for solver in solvers.values():
        # so that the figures do not depend on earlier rows
        solver.reset()
        solver.solve(warm)
    rng = np.random.default_rng(seed)
    for _ in range(frames):
        scene = maker.scene(settings, rng)
        floor = best_attitude(maker.camera, maker.stars, scene) if settings.sky else None
        predicted = None
        if settings.predicted_px:
            turn = settings.predicted_px * maker.camera.pixel_scale_rad * rng.standard_normal(3)
            predicted = scene.attitude.rotated(turn)
        for name, solver in solvers.items():
            if spent[name] > budget_s:
                continue
            if predicted is not None and solver.track is not None:
                reply = solver.track(scene, predicted, WINDOW_SIGMAS * settings.predicted_px)
            else:
                reply = solver.solve(scene)
            spent[name] += reply.cpu_seconds
            tallies[name].add(scene, floor, reply)
    return list(tallies.values())


def best_attitude(camera: Camera, stars: StarCatalog, scene: Scene) -> Attitude:
    """Least-squares attitude in pixels from the true matches: the bound for any solver.

    Gauss–Newton from the truth; with fewer than two true stars the truth is returned.
    """
    true = scene.star >= 0
    attitude = scene.attitude
    if int(true.sum()) < 2:
        return attitude
    vectors = stars.vectors[scene.star[true]]
    for _ in range(_FLOOR_STEPS):
        directions = attitude.to_sensor(vectors)
        xy, _ = camera.project(directions)
        x, y, z = directions.T
        zero = np.zeros_like(x)
        # a rotation by v moves a direction by direction × v
        moves = np.stack(
            [np.stack([zero, -z, y], 1), np.stack([z, zero, -x], 1), np.stack([-y, x, zero], 1)], axis=1
        )
        slopes = (camera.jacobian(directions) @ moves).reshape(-1, 3)
        residual = (scene.xy_px[true] - xy).ravel()
        attitude = attitude.rotated(np.linalg.solve(slopes.T @ slopes, slopes.T @ residual))
    return attitude


def _is_off(found: Attitude, expected: Attitude) -> bool:
    error = found.error_to(expected)
    return error.cross_boresight_arcsec > WRONG_ARCSEC or error.roll_arcsec > WRONG_ROLL_ARCSEC


def _orthonormal(matrix: Array) -> Array:
    """Nearest rotation to a matrix in single precision."""
    u, _, v = np.linalg.svd(matrix.astype(np.float64))
    rotation: Array = u @ np.diag([1.0, 1.0, math.copysign(1.0, float(np.linalg.det(u @ v)))]) @ v
    return rotation


def _median(values: Sequence[float]) -> float | None:
    return float(np.median(values)) if len(values) else None


def _ratio(value: float | None, bound: float | None) -> float | None:
    return value / bound if value is not None and bound else None
