"""The algorithms to which the thesis is compared, run on its frames: figures 6.9–6.11 and table 6.2."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from typing import Any, Final

import numpy as np

from starid.arrays import Array
from starid.lab.classic.registry import CLASSICS, class_of, make_identifier
from starid.lab.experiments.classics_sky import SkyName, ThesisSky, thesis_sky
from starid.lab.experiments.comparison import published
from starid.lab.experiments.experiment import (
    Context,
    Experiment,
    Outcome,
    Parameters,
    Part,
    Results,
    Row,
    row,
    write_lines,
)
from starid.lab.experiments.lsi_noise import IDENTIFIED_DEG
from starid.lab.experiments.lsi_trials import centres, share
from starid.lab.simulation import NoiseModel, add_noise
from starid.plots import figure, save
from starid.thesis.metrics import boresight_error

SHORT: Final = {
    "pyramid": "PA",
    "grid": "GA",
    "modified-grid": "MGA",
    "improved-grid": "IG",
    "match-group": "MG",
    "geometric-voting": "GV",
    "iterative": "IA",
    "subgraph": "SGS",
    "log-polar": "LPT",
    "vector-pattern": "VP",
    "svd": "SVD",
    "oriented-svd": "OSV",
    "pole-star": "PS",
    "radial-cyclic": "RC",
    "radial-dynamic-cyclic": "RDC",
    "multi-poles": "MP",
    "ant-colony": "AAC",
    "correlation": "CA",
    "lsi": "LSI (thesis)",
    "geometric": "geometric (ours)",
}
IN_TABLE_6_2: Final = (
    "pyramid", "modified-grid", "log-polar", "vector-pattern", "grid", "svd", "oriented-svd", "lsi",
)  # fmt: skip

_CASES: Final = (
    "none",
    *(f"{kind}-{level}" for kind in ("position", "brightness", "false", "missing") for level in (1, 2, 3)),
)
_LABELS: Final = {
    "position": "position noise, σ = {} px",
    "brightness": "brightness noise, σ = {} intensity units",
    "false": "false stars: {}",
    "missing": "missing stars: {}",
}
_OWN_SKY: Final = {"lsi": "flat", "geometric": "sphere"}
"""The sky for which an algorithm of this project, or of the thesis, is designed."""

_SKY_LABELS: Final = {"flat": "the thesis's flat sky", "sphere": "the same stars on the sphere"}
_SENSOR: Final = (12.0, 1024, 6.0)
"""Sensor that most of the papers simulate: field in degrees, pixels, faintest star."""

_NOTE: Final = """The thesis takes the competitors' figures from two papers with different simulators, sensors
and catalogues. Here every algorithm is run, as published and unverified, on the frames of the thesis: its
centres, stars (Hp ≥ 11.5) and noise. A frame counts as identified if the boresight is within {limit}° of the
truth, as in the thesis; answers farther off are "wrong". Each algorithm is given the σ of the position noise.
There are two skies: the flat (α, δ) plane of the thesis, and the same stars on the sphere, which its LSI
cannot use.

**What differs, and why.** (1) False stars break the thesis's algorithm (figure 6.11), because its features
depend on every star. Up to three hardly affect the classic algorithms. (2) One unit of brightness noise is
{unit:.4f} mag, which hardly affects algorithms that use positions. The papers have σ in *magnitudes*, with
stars crossing the detection threshold: not the same quantity. (3) Pair distances alone (GV, IA and, to a
lesser degree, PA and SGS) cease to be unique when the tolerance grows with the noise. How soon depends on the
tolerance and the number of guide stars, which the thesis does not state. (4) Sizes and times: here they are for up
to {stars} faint stars and compiled code; the remark "12° sensor" gives the size for the sensor of most
papers, 12° and stars to V 6. Times are wall time on the machine that made this report. (5) The papers' guide
stars are evenly spread. On the flat sky their density falls with distance from its equator, so that PA has
only two stars in one frame in sixty, and fails there."""


def table_6_2(name: str) -> list[float]:
    """Database in kB and run time in ms."""
    return published("classics", f"table 6.2, {name}")


def _parts(parameters: Parameters) -> list[Part]:
    return [
        Part(f"{sky}-{name}", {"sky": sky, "algorithm": name})
        for sky in parameters["skies"]
        for name in parameters["algorithms"]
        if name in CLASSICS or sky == _OWN_SKY[name]
    ]


def _noise(case: str) -> NoiseModel:
    kind, _, level = case.partition("-")
    return NoiseModel(
        position_sigma_px=float(level) if kind == "position" else 0.0,
        brightness_sigma=float(level) if kind == "brightness" else 0.0,
        false_stars=int(level) if kind == "false" else 0,
        missing_stars=int(level) if kind == "missing" else 0,
    )


def _identify_frames(
    context: Context, sky: ThesisSky, name: str, solver: Any, noise: NoiseModel, frames: Array
) -> tuple[Array, Array]:
    """ε_f of each frame, degrees, NaN if there is no answer; and times, milliseconds."""
    errors, times = np.full(len(frames), np.nan), np.empty(len(frames))
    rng = context.rng(sky.name, repr(noise))
    for i, (ra, dec) in enumerate(frames):
        if name == "lsi":
            errors[i], times[i] = _lsi(context, rng, ra, dec, noise)
            continue
        xy, flux = sky.observe(rng, ra, dec, noise)
        sigmas = np.full(len(flux), max(noise.position_sigma_px, 0.1))
        begin = time.perf_counter()
        solution = solver.identify(xy, flux, sigmas)
        times[i] = 1e3 * (time.perf_counter() - begin)
        if solution.valid:
            found = sky.boresight_deg(solution.attitude)
            errors[i] = _distance(sky.name, found, (ra, dec))
    return errors, times


def _distance(sky: SkyName, found: tuple[float, float], true: tuple[float, float]) -> float:
    """Error of a boresight, degrees, in the plane or on the sphere."""
    if sky == "flat":
        return float(boresight_error(*found, *true))
    a, b = (
        np.array([math.cos(d) * math.cos(r), math.cos(d) * math.sin(r), math.sin(d)])
        for r, d in (np.radians(found), np.radians(true))
    )
    return math.degrees(2.0 * math.asin(min(0.5 * float(np.linalg.norm(a - b)), 1.0)))


def _lsi(
    context: Context, rng: np.random.Generator, ra: float, dec: float, noise: NoiseModel
) -> tuple[float, float]:
    """ε_f, degrees, and time, milliseconds, of the thesis's algorithm on a frame of its flat sky."""
    from starid.thesis.features import extract_features

    lsi, sky = context.lost_in_space(0.995), context.sky()
    brightness, positions, _ = sky.stars_in_frame(ra % 360.0, dec)
    brightness, positions, _ = add_noise(rng, brightness, positions, noise, sky.half_width)
    begin = time.perf_counter()
    answer = lsi.solve(extract_features(brightness, positions)).mse
    elapsed = 1e3 * (time.perf_counter() - begin)
    return _distance("flat", (answer.right_ascension_deg, answer.declination_deg), (ra, dec)), elapsed


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


def _compute(context: Context, part: Part) -> Results:
    sky, name = thesis_sky(part.values["sky"]), part.values["algorithm"]
    frames = centres(context.parameters["every"])
    solver = _solver(sky, name)
    first = _noise("none")
    _identify_frames(context, sky, name, solver, first, frames[:1])
    results: Results = {}
    for case in context.parameters["cases"] or _CASES:
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
    from starid.camera import Camera

    fov, pixels, limit = _SENSOR
    papers: Any = make_identifier(name, Camera.from_fov(fov, pixels, pixels), limiting_magnitude=limit)
    return 1e-3 * solver.database_bytes, 1e-3 * papers.database_bytes, papers.build_seconds


def _rate(results: Results, case: str) -> float:
    return share(results[f"f_{case}"], IDENTIFIED_DEG)


def _wrong(results: Results, case: str) -> float:
    return 100.0 * float(np.mean(results[f"f_{case}"] > IDENTIFIED_DEG))


def _case_label(case: str) -> str:
    kind, _, level = case.partition("-")
    return _LABELS[kind].format(level) if level else "no noise"


def _rows(context: Context, results: Mapping[str, Results]) -> list[Row]:
    rows = []
    for sky in context.parameters["skies"]:
        for case in context.parameters["cases"] or _CASES:
            for part in _parts(context.parameters):
                if part.values["sky"] != sky:
                    continue
                name, result = part.values["algorithm"], results[part.key]
                rows.append(
                    row(
                        f"{SHORT[name]}, {_SKY_LABELS[sky]}, {_case_label(case)}: identified",
                        published=next(iter(published("classics", f"{name}, {case}")), None),
                        ours=_rate(result, case),
                        unit="%",
                        at_least=_FLOORS.get(name) if case == "none" else None,
                        remark=f"{_wrong(result, case):.1f} % wrong" if _wrong(result, case) > 0.0 else "",
                    )
                )
    first = context.parameters["skies"][0]
    # the first sky is the flat one if both are selected
    for name in IN_TABLE_6_2:
        key, (size, milliseconds) = f"{first}-{name}", table_6_2(name)
        if key not in results:
            continue
        here, papers, build = results[key]["kb"]
        at_sensor = "" if math.isnan(papers) else f"12° sensor: {papers:.0f} kB, built in {build:.2f} s"
        rows += [
            row(
                f"{SHORT[name]}: database",
                published=size,
                ours=float(here),
                unit="kB",
                digits=0,
                remark=at_sensor,
            ),
            row(
                f"{SHORT[name]}: median time, no noise",
                published=milliseconds,
                ours=float(np.median(results[key]["ms_none"])),
                unit="ms",
            ),
        ]
    return rows


_FLOORS: Final = {
    **dict.fromkeys(
        ("modified-grid", "improved-grid", "match-group", "subgraph", "oriented-svd", "geometric"),
        98.0,
    ),
    **dict.fromkeys(
        ("pyramid", "grid", "iterative", "geometric-voting", "log-polar", "vector-pattern", "lsi"), 95.0
    ),
}
"""Share of clean frames that a faithful implementation of an algorithm must identify, %."""


def _figures(context: Context, results: Mapping[str, Results]) -> list[str]:
    files = []
    plots = (
        (9, "position", "σ of position noise / px"),
        (10, "brightness", "σ of brightness noise / intensity units"),
        (11, "false", "false stars"),
        (8, "missing", "missing stars"),
    )
    cases = context.parameters["cases"] or _CASES
    for number, kind, label in plots:
        levels = [level for level in range(4) if (f"{kind}-{level}" if level else "none") in cases]
        if levels == [0]:
            continue
        skies = context.parameters["skies"]
        fig, axes = figure(1, len(skies), width=5.5 * len(skies), height=4.4, squeeze=False)
        for axis, sky in zip(axes[0], skies, strict=True):
            for i, part in enumerate(p for p in _parts(context.parameters) if p.values["sky"] == sky):
                rates = [_rate(results[part.key], f"{kind}-{level}" if level else "none") for level in levels]
                own = part.values["algorithm"] not in CLASSICS
                axis.plot(
                    levels,
                    rates,
                    linestyle=("-", "--", ":")[i % 3],
                    linewidth=2.0 if own else 1.2,
                    marker="o",
                    ms=3,
                    color="black" if own else f"C{i % 10}",
                    label=SHORT[part.values["algorithm"]],
                )
            for level in levels:
                for name in SHORT:
                    for value in published(
                        "classics", f"{name}, {kind}-{level}" if level else f"{name}, none"
                    ):
                        axis.plot([level], [value], "rx", ms=7)
            axis.set(
                xlabel=label, ylabel="identified / %", title=_SKY_LABELS[sky], xticks=levels, ylim=(0, 102)
            )
            axis.legend(ncols=2, fontsize=6)
        files.append(save(fig, context.folder / f"figure_6_{number}_classics.png"))
    return files


def _evaluate(context: Context, results: Mapping[str, Results]) -> Outcome:
    lines = []
    for part in _parts(context.parameters):
        result = results[part.key]
        for case in context.parameters["cases"] or _CASES:
            times = result[f"ms_{case}"]
            line = {**part.values, "case": case}
            line |= {"identified_percent": _rate(result, case), "wrong_percent": _wrong(result, case)}
            line |= {"median_ms": float(np.median(times)), "p99_ms": float(np.percentile(times, 99.0))}
            lines.append(line)
    files = [write_lines(context.folder / "rates.csv", lines), *_figures(context, results)]
    stars = len(thesis_sky("sphere").catalog)
    note = _NOTE.format(limit=IDENTIFIED_DEG, unit=NoiseModel().magnitude_per_unit, stars=stars)
    return Outcome(tuple(_rows(context, results)), tuple(files), (note,))


EXPERIMENTS: Final = (
    Experiment(
        "classics",
        "The published algorithms on the thesis's frames: figures 6.9–6.11, table 6.2",
        _parts,
        _compute,
        _evaluate,
        full={
            "algorithms": [*CLASSICS, "lsi", "geometric"],
            "skies": ["flat", "sphere"],
            "cases": [],
            "every": 9,
        },
        quick={
            "algorithms": list(CLASSICS),
            "skies": ["flat"],
            "cases": ["none", "position-3", "false-3"],
            "every": 340,
        },
        alone=True,
        start_order=1,
    ),
)
