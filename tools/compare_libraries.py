"""Compare kernels of starid with libraries that could replace them: `pip install sep`, then run this file.

Both get the same input and are timed on one thread. The figures are in docs/design-decisions.md.
"""

from __future__ import annotations

import argparse
import time
import warnings
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from starhil.emulator.sensor.model import SensorModel
from starhil.emulator.sensor.renderer import Renderer
from starid.attitude import random_attitude
from starid.camera import Camera
from starid.catalog import load_catalog
from starid.identification.thesis.fsf import density_clusters
from starid.identification.thesis.lasso import LAMBDAS, lasso_path
from starid.imaging.detection import detect

Array = np.ndarray[Any, np.dtype[Any]]
Measurement = tuple[str, float, str]

ISOLATION_PX = 12.0
"""Only stars at least this far from any other are compared."""

MATCH_PX = 1.5
FAINTEST_MAGNITUDE = 5.5


def median_ms(work: Callable[[], object], repetitions: int) -> float:
    """Median processor time of a call, milliseconds, after a warm-up call."""
    work()
    times = []
    for _ in range(repetitions):
        begin = time.thread_time()
        work()
        times.append(time.thread_time() - begin)
    return 1e3 * float(np.median(times))


def detection(frames: int, seed: int) -> list[Measurement]:
    """Detect stars in rendered images: time per image, and position error per axis."""
    import sep

    camera, sensor = Camera.from_fov(), SensorModel()
    renderer = Renderer(camera, load_catalog(), sensor, seed)
    settings = sensor.detection_settings()
    rng = np.random.default_rng(seed)

    def theirs(image: Array) -> Array:
        data = image.astype(np.float32)
        background = sep.Background(data)
        objects = sep.extract(data - background, 3.0, err=background.globalrms, minarea=3)
        sigma = np.full(len(objects), sensor.psf_sigma_px)
        x, y, _ = sep.winpos(data - background, objects["x"], objects["y"], sigma)
        return np.column_stack([x, y])

    def ours(image: Array) -> Array:
        return detect(image, settings).xy_px

    finders = {"starid.detect": ours, "sep": theirs}
    times: dict[str, list[float]] = {name: [] for name in finders}
    errors: dict[str, list[Array]] = {name: [] for name in finders}
    for index in range(frames):
        frame = renderer.render(random_attitude(rng), np.zeros(3), index)
        positions = {name: find(frame.image) for name, find in finders.items()}
        for name, find in finders.items():
            times[name].append(median_ms(partial(find, frame.image), 1))
        stars = frame.stars.xy_px
        distance, _ = cKDTree(stars).query(stars, k=2)
        inside = np.all((stars > ISOLATION_PX) & (stars < camera.width - 1 - ISOLATION_PX), axis=1)
        selection = (distance[:, 1] > ISOLATION_PX) & inside & (frame.stars.magnitude <= FAINTEST_MAGNITUDE)
        nearest = {name: cKDTree(places).query(stars[selection]) for name, places in positions.items()}
        both = np.all([gap < MATCH_PX for gap, _ in nearest.values()], axis=0)
        for name, (_, row) in nearest.items():
            errors[name].append(positions[name][row[both]] - stars[selection][both])
    return [
        (
            f"{name}, {sum(map(len, errors[name]))} stars in {frames} images",
            float(np.median(times[name])),
            f"{float(np.sqrt(np.mean(np.concatenate(errors[name]) ** 2))):.4f} px rms per axis",
        )
        for name in finders
    ]


def lasso(problems: int, seed: int) -> list[Measurement]:
    """LASSO of five features and nine similar cells, at the thesis's hundred values of λ."""
    from sklearn.linear_model import lasso_path as sklearn_path

    rng = np.random.default_rng(seed)
    columns = 50.0 + 30.0 * rng.random((problems, 5, 1)) + 2.0 * rng.standard_normal((problems, 5, 9))
    observations = columns.mean(axis=2) + rng.standard_normal((problems, 5))
    weights = np.empty((LAMBDAS.size, 9))
    falling = LAMBDAS[::-1].copy()

    def objective(index: int, omega: Array) -> Array:
        residual = observations[index][:, None] - columns[index] @ omega.T
        return (residual**2).sum(axis=0) / 10.0 + LAMBDAS * np.abs(omega).sum(axis=1)

    def theirs(index: int) -> Array:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return sklearn_path(columns[index], observations[index], alphas=falling)[1].T[::-1]

    def ours(index: int) -> Array:
        lasso_path(columns[index], observations[index], LAMBDAS, weights)
        return weights

    excess = np.array([objective(i, theirs(i)) - objective(i, ours(i)) for i in range(problems)])
    return [
        (
            f"{name}, {problems} problems",
            median_ms(lambda solve=solve: [solve(i) for i in range(problems)], 5) / problems,  # type: ignore[misc]
            note,
        )
        for name, solve, note in (
            ("starid.identification.thesis.lasso", ours, "exact"),
            ("sklearn.linear_model.lasso_path", theirs, f"minimum missed by up to {excess.max():.2g}"),
        )
    ]


def clusters(seed: int) -> list[Measurement]:
    """Cluster the disparities of the thesis's filter, for 7 and for 12 objects."""
    from sklearn.cluster import DBSCAN

    rng = np.random.default_rng(seed)
    rows: list[Measurement] = []
    for objects in (7, 12):
        pairs = objects * (objects - 1) // 2
        points = rng.uniform([-4.0, -20.0, -20.0], [4.0, 20.0, 20.0], (pairs**2, 3))
        points[:pairs] = rng.normal(0.0, 0.1, (pairs, 3))
        least = 0.5 * objects
        scan = DBSCAN(eps=0.4, min_samples=int(np.ceil(least)))
        same = np.array_equal(scan.fit(points).labels_, density_clusters(points, 0.4, least))
        note = "same labels" if same else "labels differ"
        of = f"{pairs**2} points"
        rows.append((f"starid.identification.thesis.fsf, {of}", median_ms(lambda p=points, m=least: density_clusters(p, 0.4, m), 9), note))  # type: ignore[misc]  # fmt: skip
        rows.append((f"sklearn.cluster.DBSCAN, {of}", median_ms(lambda p=points, s=scan: s.fit(p), 9), note))  # type: ignore[misc]
    return rows


def main() -> None:
    """Print one line for each program and input."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--frames", type=int, default=40, help="images for detection (default 40)")
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args()
    for rows in (
        detection(arguments.frames, arguments.seed),
        lasso(200, arguments.seed),
        clusters(arguments.seed),
    ):
        for name, milliseconds, note in rows:
            print(f"{name:<48} {milliseconds:9.3f} ms  {note}")


if __name__ == "__main__":
    main()
