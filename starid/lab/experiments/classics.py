"""The algorithms to which the thesis is compared, run on its frames: figures 6.9–6.11 and table 6.2."""

from __future__ import annotations

import itertools
import math
import time
from typing import Any, Final

import numpy as np

from starid.arithmetic.arrays import Array
from starid.camera import Camera
from starid.identification.thesis.features import extract_features
from starid.identification.thesis.metrics import boresight_error
from starid.lab.classic.registry import CLASSICS, class_of, make_identifier
from starid.lab.experiments.classics_sky import SkyName, ThesisSky, thesis_sky
from starid.lab.experiments.experiment import Context, Evaluation, Parameters, Part, Results
from starid.lab.experiments.figures import Curve, Panel, curves_of
from starid.lab.experiments.lsi_noise import IDENTIFIED_DEG
from starid.lab.experiments.lsi_trials import centres, error_of, share, stars_of
from starid.lab.experiments.tables import published, read_lines
from starid.lab.simulation import NoiseModel

_COMPETITORS: Final = {line["name"]: line for line in read_lines("competitors.csv")}

SHORT: Final = {name: line["short"] for name, line in _COMPETITORS.items()}
"""Name of an algorithm → its abbreviation in the thesis."""

IN_TABLE_6_2: Final = tuple(name for name in SHORT if published("classics", f"table 6.2, {name}"))

_LABELS: Final = {
    "position": "position noise, σ = {} px",
    "brightness": "brightness noise, σ = {} intensity units",
    "false": "false stars: {}",
    "missing": "missing stars: {}",
}
_OWN_SKY: Final = {"lsi": "flat", "geometric": "sphere"}
"""The sky for which an algorithm of this project, or of the thesis, is designed."""

_SENSOR: Final = (12.0, 1024, 6.0)
"""Sensor that most of the papers simulate: field in degrees, pixels, faintest star."""
_SKY_LABELS: Final = {"flat": "the thesis's flat sky", "sphere": "the same stars on the sphere"}


def parts(parameters: Parameters) -> list[Part]:
    """The published algorithms on each sky, and those of `_OWN_SKY` on theirs; or `algorithms`, if given."""
    return [
        Part(f"{sky}-{name}", {"sky": sky, "algorithm": name})
        for sky in parameters["skies"]
        for name in parameters.get("algorithms", [*CLASSICS, *_OWN_SKY])
        if name in CLASSICS or sky == _OWN_SKY[name]
    ]


def _noise(case: str) -> NoiseModel:
    kind, _, level = case.partition("-")
    return NoiseModel.of(kind, float(level or 0))


def _identify_frames(
    context: Context, sky: ThesisSky, name: str, solver: Any, noise: NoiseModel, frames: Array
) -> tuple[Array, Array]:
    """ε_f of each frame, degrees, NaN if there is no answer; and times, milliseconds."""
    errors, times = np.full(len(frames), np.nan), np.empty(len(frames))
    rng = context.rng(sky.name, repr(noise))
    if name == "lsi":
        return _lsi(context, rng, frames, noise)
    for i, (ra, dec) in enumerate(frames):
        xy, flux = sky.observe(rng, ra, dec, noise)
        sigmas = np.full(len(flux), max(noise.position_sigma_px, 0.1))
        begin = time.perf_counter()
        solution = solver.identify(xy, flux, sigmas)
        times[i] = 1e3 * (time.perf_counter() - begin)
        if solution.valid:
            found = sky.boresight_deg(solution.attitude)
            errors[i] = _distance(sky.name, found, (ra, dec))
    return errors, times


def _distance(sky: SkyName, answer: tuple[float, float], true: tuple[float, float]) -> float:
    """Error of a boresight, degrees, in the plane or on the sphere."""
    if sky == "flat":
        return float(boresight_error(*answer, *true))
    a, b = (
        np.array([math.cos(d) * math.cos(r), math.cos(d) * math.sin(r), math.sin(d)])
        for r, d in (np.radians(answer), np.radians(true))
    )
    return math.degrees(2.0 * math.asin(min(0.5 * float(np.linalg.norm(a - b)), 1.0)))


def _lsi(context: Context, rng: np.random.Generator, frames: Array, noise: NoiseModel) -> tuple[Array, Array]:
    """The same of the thesis's algorithm on its flat sky."""
    lsi = context.lost_in_space(0.995)
    errors, times = np.empty((2, len(frames)))
    for i, stars in enumerate(stars_of(context.sky(), frames, rng, lambda _: noise)):
        begin = time.perf_counter()
        answer = lsi.solve(extract_features(*stars)).mse
        times[i] = 1e3 * (time.perf_counter() - begin)
        errors[i] = error_of(answer, *frames[i])
    return errors, times


def _solver(sky: ThesisSky, name: str) -> Any:
    if name == "lsi":
        return None
    if name == "geometric":
        return make_identifier(name, sky.camera, sky.catalog, limiting_magnitude=float(sky.catalog.v[-1]))
    own_choice: float = class_of(name).stars_per_field
    per_field = min(own_choice, sky.stars_per_field)
    solver: Any = make_identifier(
        name,
        sky.camera,
        sky.catalog,
        verify=False,
        zero_point=0.0,
        stars_per_field=per_field,
        limiting_magnitude=sky.limit_for(per_field),
    )
    solver.warm_up()
    return solver


def compute(context: Context, part: Part) -> Results:
    """ε_f and times of each case (n,), and size and build time of the database."""
    sky, name = thesis_sky(part["sky"]), part["algorithm"]
    frames = centres(context.parameters["every"])
    solver = _solver(sky, name)
    first = _noise("none")
    _identify_frames(context, sky, name, solver, first, frames[:1])
    results: Results = {}
    for case in context.parameters["cases"]:
        errors, times = _identify_frames(context, sky, name, solver, _noise(case), frames)
        results[f"f_{case}"], results[f"ms_{case}"] = errors, times
    results["kb"] = np.array(_database_figures(context, name, solver))
    return results


def _database_figures(context: Context, name: str, solver: Any) -> tuple[float, float, float]:
    """Return the size of the database here and for the papers' sensor, kB, and its build time there, s; or NaN."""
    if name == "lsi":
        # five 8-bit features per cell; the coordinates follow from the number of the cell
        return 5e-3 * context.lost_in_space(0.995).database.cells, math.nan, math.nan
    if name not in CLASSICS:
        return math.nan, math.nan, math.nan

    fov, pixels, limit = _SENSOR
    papers: Any = make_identifier(name, Camera.from_fov(fov, pixels, pixels), limiting_magnitude=limit)
    return 1e-3 * solver.database_bytes, 1e-3 * papers.database_bytes, papers.build_seconds


def _case_label(case: str) -> str:
    kind, _, level = case.partition("-")
    return _LABELS[kind].format(level) if level else "no noise"


def _compare(e: Evaluation, lines: list[dict[str, Any]]) -> None:
    skies = e.parameters["skies"]
    for sky, case in itertools.product(skies, e.parameters["cases"]):
        for line in lines:
            if (line["sky"], line["case"]) != (sky, case):
                continue
            name, wrong = line["algorithm"], line["wrong_percent"]
            e.compare(
                f"{SHORT[name]}, {_SKY_LABELS[sky]}, {_case_label(case)}: identified",
                text=next(iter(e.published(f"{name}, {case}")), None),
                unit="%",
                check=f"≥ {floor}" if (floor := _COMPETITORS[name]["least_clean"]) and case == "none" else "",
                ours=line["identified_percent"],
                remark=f"{wrong:.1f} % wrong" if wrong > 0.0 else "",
            )
    # the first sky is the flat one if both are selected
    for name in IN_TABLE_6_2:
        result = e.results.get(f"{skies[0]}-{name}")
        if result is None:
            continue
        size, milliseconds = e.published(f"table 6.2, {name}")
        here, papers, build = (float(figure) for figure in result["kb"])
        at_sensor = "" if math.isnan(papers) else f"12° sensor: {papers:.0f} kB, built in {build:.2f} s"
        e.compare(f"{SHORT[name]}: database", text=size, unit="kB", digits=0, ours=here, remark=at_sensor)
        median = float(np.median(result["ms_none"]))
        e.compare(f"{SHORT[name]}: median time, no noise", text=milliseconds, unit="ms", ours=median)


def _figures(e: Evaluation, lines: list[dict[str, Any]]) -> None:
    """Draw the rates of all algorithms, and the published ones as crosses."""
    for number, kind, label in (
        (9, "position", "σ of position noise / px"),
        (10, "brightness", "σ of brightness noise / intensity units"),
        (11, "false", "false stars"),
        (8, "missing", "missing stars"),
    ):
        levels = {f"{kind}-{level}" if level else "none": level for level in range(4)}
        members = [line | {"level": levels[line["case"]]} for line in lines if line["case"] in levels]
        if not any(line["level"] for line in members):
            continue
        published = [
            Curve([level], e.published(f"{name}, {case}"), "x", "", {"color": "red", "ms": 7})
            for (case, level), name in itertools.product(levels.items(), SHORT)
            if e.published(f"{name}, {case}")
        ]
        shown = []
        for sky in e.parameters["skies"]:
            rates = [line for line in members if line["sky"] == sky]
            curves = curves_of(rates, "level", "identified_percent", lambda line: SHORT[line["algorithm"]])
            settings = {"xlabel": label, "ylabel": "identified / %", "xticks": range(4), "ylim": (0, 102)}
            shown.append(Panel(_SKY_LABELS[sky], [*curves, *published], settings))
        look = {"columns": len(shown), "width": 5.5 * len(shown), "height": 4.4, "legend": "best"}
        e.draw(f"figure_6_{number}_classics.png", shown, **look)


def evaluate(e: Evaluation) -> None:
    """Rates, wrong answers, sizes and times of each algorithm beside the quoted ones."""
    lines = []
    for part, case in itertools.product(e.parts, e.parameters["cases"]):
        errors, times = (e[part][f"{name}_{case}"] for name in ("f", "ms"))
        line = {**part.values, "case": case, "identified_percent": share(errors, IDENTIFIED_DEG)}
        line["wrong_percent"] = 100.0 * float(np.mean(errors > IDENTIFIED_DEG))
        line |= {"median_ms": float(np.median(times)), "p99_ms": float(np.percentile(times, 99.0))}
        lines.append(line)
    e.write("rates.csv", lines)
    _figures(e, lines)
    _compare(e, lines)
    stars, unit = len(thesis_sky("sphere").catalog), NoiseModel().magnitude_per_unit
    e.note = {"limit": IDENTIFIED_DEG, "unit": unit, "stars": stars}
