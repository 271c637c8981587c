"""Report of a performance campaign per ECSS-E-ST-60-20C: a data sheet in Markdown, HTML and PDF, CSV files and plots."""

from __future__ import annotations

import csv
import hashlib
import io
import json
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any, Final

import numpy as np

from starhil.emulator.benchmarks.ecss_campaign import (
    DATED,
    INFLUENCES,
    REST,
    STATIC,
    THERMAL,
    EcssPlan,
)
from starhil.emulator.benchmarks.ecss_errors import (
    ABERRATION,
    BIAS,
    THERMO_ELASTIC,
    ErrorLine,
    ErrorSeries,
    aberration_residual,
    static_errors,
    thermo_elastic_error,
)
from starhil.emulator.benchmarks.ecss_requirements import Figure, Requirement
from starhil.emulator.benchmarks.report_files import as_html, as_pdf, code, plain
from starhil.emulator.sensor.model import SensorModel
from starid.storage.files import write_atomically
from starid.storage.results import Results

INTERVAL: Final = 0.95
"""Confidence level of the intervals for probabilities."""

SIGMAS: Final = (1, 2, 3)
"""Standard deviations within which errors are counted."""
NORMAL_SHARES: Final = tuple(math.erf(limit / math.sqrt(2.0)) for limit in SIGMAS)
"""Fractions of normal errors within them: 68.3, 95.4 and 99.7 %."""

AXES: Final = ("x", "y", "z", "across", "about")
ERRORS: Final = (
    "bias",
    "thermo_elastic",
    "field_of_view",
    "pixel",
    "noise",
    "aberration",
    "total",
    "measured",
)
"""Names of the errors in requirements, in the order of `EcssReport.all_lines`."""
OUTCOMES: Final = ("correct", "wrong", "invalid")

PLOTS: Final = {
    "ecss-errors.png": "Attitude errors by kind, across and about the boresight",
    "ecss-availability.png": "Correct and wrong attitudes against body rate, bodies near the field, false stars and particles",
}
"""File of a plot → its description."""


@dataclass(frozen=True)
class Outcomes:
    """Numbers of frames under a condition with a correct, a wrong and no attitude."""

    influence: str
    value: float
    frames: int
    correct: int
    wrong: int
    """Number of frames, of correct attitudes, and of wrong ones."""
    reasons: Mapping[str, int]
    """Reason of an invalid attitude → number of frames."""

    @property
    def invalid(self) -> int:
        """Number of frames without an attitude."""
        return self.frames - self.correct - self.wrong

    @property
    def counts(self) -> tuple[int, int, int]:
        """Numbers of frames in the order of `OUTCOMES`."""
        return self.correct, self.wrong, self.invalid

    @property
    def availability(self) -> float:
        """Fraction of frames with a valid attitude."""
        return (self.correct + self.wrong) / self.frames


@dataclass(frozen=True)
class Stated:
    """A standard deviation that the device states with its attitudes, compared with their errors."""

    axes: str
    arcsec: float
    """Median of the stated ones."""
    shares: tuple[float, ...]
    """Fractions of the errors about each axis within `SIGMAS` stated standard deviations."""
    frames: int
    """Number of images; the errors about two axes in one image are not taken as independent."""

    def interval(self, place: int) -> tuple[float, float]:
        return interval(round(self.shares[place] * self.frames), self.frames)

    @property
    def verdict(self) -> str:
        """What the comparison with normal errors says."""
        most, normal = self.interval(2)[1], NORMAL_SHARES[2]
        if most < normal:
            return f"**too small**: {100 * self.shares[2]:.1f} % of the errors are within 3σ, where {100 * normal:.1f} % should be"
        if self.interval(0)[0] > NORMAL_SHARES[0]:
            return (
                "larger than the errors: safe; a filter that uses it trusts the attitudes less than it could"
            )
        return "consistent with the errors"

    @classmethod
    def of(cls, axes: str, errors: np.ndarray, stated: np.ndarray) -> Stated:
        """Compare errors (n, axes) with the stated uncertainties (n,), both in arcseconds."""
        within = np.abs(errors) / stated[:, None]
        shares = tuple(float(np.mean(within <= limit)) for limit in SIGMAS)
        return cls(axes, float(np.median(stated)), shares, len(errors))


@dataclass(frozen=True)
class EcssReport:
    """Figures of a campaign."""

    plan: EcssPlan
    confidence: float
    lines: tuple[ErrorLine, ...]
    measured_arcsec: np.ndarray
    """Quantile of the errors at rest about x, y and z at the confidence level, over sky and orbit."""
    outcomes: tuple[Outcomes, ...]
    """Correct, wrong and invalid attitudes by condition; the first is at rest."""
    stars: float
    """Median number of stars detected at rest."""
    stated: tuple[Stated, Stated]
    """The uncertainty that the device states at rest, across the boresight and about it."""

    @property
    def total(self) -> ErrorLine:
        """Sum of bias, thermo-elastic error and the root sum of squares of the others, without aberration."""
        arcsec = {line.name: line.arcsec for line in self.lines if line.arcsec is not None}
        steady = [arcsec.pop(name) for name in (BIAS, THERMO_ELASTIC)]
        random = [size for name, size in arcsec.items() if name != ABERRATION]
        summed = np.sum(steady, axis=0) + np.sqrt(np.sum(np.square(random), axis=0))
        return ErrorLine("total without aberration", np.asarray(summed), np.zeros(3))

    @property
    def measured(self) -> ErrorLine:
        """Quantile of all errors at rest."""
        return ErrorLine("measured over sky and orbit, without aberration", self.measured_arcsec, np.zeros(3))

    @property
    def all_lines(self) -> tuple[ErrorLine, ...]:
        """Errors by kind, their total, and the measured errors."""
        return (*self.lines, self.total, self.measured)

    def named_figures(self) -> dict[str, Figure]:
        """Return the figures on which there can be requirements; `figure_names` are their names."""
        figures = {}
        for name, line in zip(ERRORS, self.all_lines, strict=True):
            figures.update({f"{name}.{axis}": figure for axis, figure in _axes_of(line)})
        for outcome in self.outcomes:
            for what, count in zip(OUTCOMES, outcome.counts, strict=True):
                shares = (count / outcome.frames, *interval(count, outcome.frames))
                figures[f"{_condition(outcome.influence, outcome.value)}.{what}"] = _percent(*shares)
        for axes, item in zip(AXES[3:], self.stated, strict=True):
            figures[f"stated.{axes}.sigma"] = Figure(item.arcsec, item.arcsec, item.arcsec, "″")
            for place, limit in enumerate(SIGMAS):
                figures[f"stated.{axes}.within_{limit}"] = _percent(item.shares[place], *item.interval(place))
        return figures

    def figures(self) -> dict[str, Any]:
        lines = {
            line.name: None
            if line.arcsec is None
            else dict(zip(("x", "y", "z"), line.arcsec.tolist(), strict=True))
            | {"across": line.across_arcsec, "about": line.about_arcsec}
            for line in self.all_lines
        }
        rest = self.outcomes[0]
        return {
            "profile": self.plan.profile,
            "seed": self.plan.seed,
            "confidence": self.confidence,
            "errors_arcsec": lines,
            "availability": rest.availability,
            "frames": rest.frames,
            "wrong": sum(outcome.wrong for outcome in self.outcomes),
            "frames_of_all_conditions": sum(outcome.frames for outcome in self.outcomes),
            "stars_median": self.stars,
            "stated": {
                item.axes: {
                    "arcsec": item.arcsec,
                    **{
                        f"within_{limit}_sigma": share
                        for limit, share in zip(SIGMAS, item.shares, strict=True)
                    },
                }
                for item in self.stated
            },
        }


def figure_names() -> list[str]:
    """Return the names of all figures on which there can be requirements."""
    conditions = [
        REST,
        *(_condition(name, value) for name, (_, _, values) in INFLUENCES.items() for value in values),
    ]
    stated = ("sigma", *(f"within_{limit}" for limit in SIGMAS))
    return [
        *(f"{error}.{axis}" for error in ERRORS for axis in AXES),
        *(f"{condition}.{outcome}" for condition in conditions for outcome in OUTCOMES),
        *(f"stated.{axes}.{figure}" for axes in AXES[3:] for figure in stated),
    ]


def _condition(influence: str, value: float) -> str:
    return REST if influence == REST else f"{influence}.{value:g}"


def _percent(value: float, low: float, high: float) -> Figure:
    return Figure(100.0 * value, 100.0 * low, 100.0 * high, " %")


def _axes_of(line: ErrorLine) -> Iterator[tuple[str, Figure]]:
    """Yield the error about each of `AXES`; one that is not significant is known to be below the smallest significant one."""
    if line.arcsec is None:
        unknown = Figure(math.nan, 0.0, math.inf, "″")
        yield from ((axis, unknown) for axis in AXES)
        return
    largest = ErrorLine(
        line.name, np.where(line.arcsec > 0.0, line.arcsec, line.resolution_arcsec), line.arcsec
    )
    sizes = [
        (*each.arcsec, each.across_arcsec, each.about_arcsec)
        for each in (line, largest)
        if each.arcsec is not None
    ]
    for axis, size, most in zip(AXES, *sizes, strict=True):
        yield axis, Figure(float(size), float(size), float(most), "″")


def subject(plan: EcssPlan) -> dict[str, str]:
    """Return what a report is about: the camera and its settings, and what has produced the figures."""
    profile, parameters, camera = plan.device()
    text = json.dumps(profile.model_dump(mode="json"), sort_keys=True)
    return {
        "profile": ", ".join(map(code, (plan.profile, *plan.overrides))),
        "checksum of the profile": f"SHA-256 {hashlib.sha256(text.encode()).hexdigest()[:16]}…",
        "camera": f"{camera.width} × {camera.height} pixels, {camera.fov_deg:.4g}° wide; focal length {camera.focal_px[0]:.5g} pixels",
        "aperture": f"{1000.0 * SensorModel().with_(**profile.sensor).aperture_m:.3g} mm",
        "exposure": f"{parameters['exposure']:g} ms, gain {parameters['analog_gain']:g}",
        "unit": plain(profile.unit_source),
        "version": f"starhil {version('starhil')}",
        "seed": str(plan.seed),
    }


def make_report(plan: EcssPlan, parts: Iterable[tuple[str, int, Results]], confidence: float) -> EcssReport:
    """Make the report of a finished campaign from its parts, which may be in any order."""
    by_name: dict[str, list[tuple[int, Results]]] = {}
    for name, chunk, results in parts:
        by_name.setdefault(name, []).append((chunk, results))
    joined = {name: _joined(pieces) for name, pieces in by_name.items()}
    static = _series(joined[STATIC])
    rest = joined[REST]
    valid = ~np.isnan(rest["error_arcsec"]).any(axis=1)
    errors, stated = np.abs(rest["error_arcsec"][valid]), rest["stated_arcsec"][valid]
    measured = np.quantile(errors, confidence, axis=0) if len(errors) else np.full(3, np.nan)
    return EcssReport(
        plan,
        confidence,
        (
            *static_errors(static, confidence)[:1],
            thermo_elastic_error(_series(joined[THERMAL]), confidence),
            *static_errors(static, confidence)[1:],
            aberration_residual(_series(joined[DATED]), static, confidence),
        ),
        measured,
        tuple(
            _outcomes(condition.influence, condition.value, joined[condition.name])
            for condition in plan.conditions()
            if condition.influence not in (STATIC, THERMAL, DATED)
        ),
        float(np.median(rest["labels"][:, 2])),
        (
            Stated.of("across the boresight", errors[:, :2], stated[:, 0]),
            Stated.of("about the boresight", errors[:, 2:], stated[:, 1]),
        ),
    )


def rest_figures(parts: Iterable[tuple[str, int, Results]]) -> dict[str, Any]:
    """Summarise the frames at rest alone, with the figures of `campaign.summarise` that they have."""
    rest = _joined([(chunk, results) for _, chunk, results in parts])
    outcome = _outcomes(REST, 0.0, rest)
    errors = rest["error_arcsec"][~np.isnan(rest["error_arcsec"]).any(axis=1)]
    cross, roll = np.hypot(errors[:, 0], errors[:, 1]), np.abs(errors[:, 2])

    def quantile(values: np.ndarray, share: float) -> float | None:
        return float(np.quantile(values, share)) if len(values) else None

    valid = outcome.correct + outcome.wrong
    return {
        "frames": outcome.frames,
        "valid": valid,
        "valid_pct": 100.0 * outcome.availability,
        "wrong": outcome.wrong,
        "invalid_reasons": dict(outcome.reasons),
        "median_arcsec": quantile(cross, 0.5),
        "p99_arcsec": quantile(cross, 0.99),
        "max_arcsec": quantile(cross, 1.0),
        "roll_median_arcsec": quantile(roll, 0.5),
        "roll_p99_arcsec": quantile(roll, 0.99),
        "stars_median": float(np.median(rest["labels"][:, 2])),
    }


def _joined(pieces: Sequence[tuple[int, Results]]) -> Results:
    ordered = [results for _, results in sorted(pieces, key=lambda piece: piece[0])]
    return {name: np.concatenate([results[name] for results in ordered]) for name in ordered[0]}


def _series(results: Results) -> ErrorSeries:
    """Return the errors of the frames with a correct attitude."""
    good = results["outcome"] == "correct"
    labels = results["labels"][good]
    return ErrorSeries(results["error_arcsec"][good], labels[:, 0], labels[:, 1], results["to_sensor"][good])


def _outcomes(influence: str, value: float, results: Results) -> Outcomes:
    names, counts = np.unique(results["outcome"], return_counts=True)
    count = dict(zip(names.tolist(), counts.tolist(), strict=True))
    correct, wrong = count.pop("correct", 0), count.pop("wrong", 0)
    return Outcomes(influence, value, len(results["outcome"]), correct, wrong, count)


def interval(count: int, frames: int) -> tuple[float, float]:
    """Return the Clopper–Pearson interval of a probability at the level `INTERVAL`."""
    from scipy.stats import beta

    tail = 0.5 * (1.0 - INTERVAL)
    low = 0.0 if count == 0 else float(beta.ppf(tail, count, frames - count + 1))
    high = 1.0 if count == frames else float(beta.isf(tail, count + 1, frames - count))
    return low, high


def as_markdown(
    report: EcssReport,
    command: str,
    requirements: Sequence[Requirement] = (),
    plots: Sequence[str] = (),
) -> str:
    """Return the report as Markdown; `plots` are names of image files in its folder."""
    from jinja2 import StrictUndefined, Template

    text = Path(__file__).with_name("ecss_report.md.j2").read_text(encoding="utf-8")
    template = Template(text, trim_blocks=True, lstrip_blocks=True, undefined=StrictUndefined)
    filled: str = template.render(
        report=report,
        plan=report.plan,
        interval=INTERVAL,
        sigmas=SIGMAS,
        influences=INFLUENCES,
        normal=NORMAL_SHARES,
        verdicts=[(item, report.named_figures()[item.figure]) for item in requirements],
        subject={**subject(report.plan), "date": f"{datetime.now(UTC):%Y-%m-%d}", "command": code(command)},
        plain=plain,
        size=_size,
        plots={plot: PLOTS[plot] for plot in plots},
        error_row=_error_row,
        shares=_shares,
        reasons=lambda outcome: _reasons(outcome, ", ", " ") or "—",
    )
    return filled.rstrip() + "\n"


def _reasons(outcome: Outcomes, between: str, is_: str) -> str:
    return between.join(f"{reason}{is_}{count}" for reason, count in outcome.reasons.items())


def _error_row(line: ErrorLine) -> str:
    if line.arcsec is None:
        return f"| {line.name} | not evaluated | not evaluated | not evaluated | — | — |"
    cells = [
        f"{size:.3g}″" if size > 0.0 else f"< {least:.2g}″"
        for size, least in zip(line.arcsec, line.resolution_arcsec, strict=True)
    ]
    across, about = line.across_arcsec, line.about_arcsec
    both = [f"{value:.3g}″" if value > 0.0 else "—" for value in (across, about)]
    return f"| {line.name} | {' | '.join(cells)} | {' | '.join(both)} |"


def _size(figure: Figure) -> str:
    """Return a figure with the interval to which it is known."""
    if math.isnan(figure.value):
        return "not evaluated"
    if figure.low == figure.high:
        return f"{figure.value:.3g}{figure.unit}"
    if figure.unit == "″":
        return f"{figure.value:.3g} to {figure.high:.3g}″"
    return f"{figure.value:.4g}{figure.unit} ({figure.low:.3g} to {figure.high:.3g})"


def _shares(outcome: Outcomes) -> str:
    """Return the cells of correct, wrong and invalid: percentages with confidence intervals."""
    cells = []
    for count in outcome.counts:
        low, high = interval(count, outcome.frames)
        cells.append(f"{100 * count / outcome.frames:.4g} % ({100 * low:.3g} to {100 * high:.3g})")
    return " | ".join(cells)


def write_report(
    report: EcssReport, command: str, requirements: Sequence[Requirement], folder: Path
) -> tuple[Path, ...]:
    """Write `report.md`, `.html` and `.pdf`, `errors.csv`, `availability.csv` and the plots; return the files."""
    plots = (_plot_errors(report, folder), _plot_availability(report, folder))
    markdown = as_markdown(report, command, requirements, [plot.name for plot in plots])
    title = f"Performance of {report.plan.profile}"
    contents = {
        "report.md": markdown.encode(),
        "report.html": as_html(markdown, title, folder).encode(),
        "report.pdf": as_pdf(markdown, title, folder),
        "errors.csv": _errors_csv(report).encode(),
        "availability.csv": _availability_csv(report).encode(),
    }
    for name, content in contents.items():
        write_atomically(folder / name, partial(Path.write_bytes, data=content))
    return (*(folder / name for name in contents), *plots)


def _csv(head: str, rows: Iterable[Sequence[object]]) -> str:
    stream = io.StringIO()
    csv.writer(stream, lineterminator="\n").writerows([head.split(), *rows])
    return stream.getvalue()


def _errors_csv(report: EcssReport) -> str:
    rows = []
    for line in report.all_lines:
        sizes = ["", "", ""] if line.arcsec is None else [f"{size:.6g}" for size in line.arcsec]
        rows.append([line.name, *sizes, *(f"{least:.6g}" for least in line.resolution_arcsec)])
    return _csv("error x_arcsec y_arcsec z_arcsec x_least y_least z_least", rows)


def _availability_csv(report: EcssReport) -> str:
    rows = []
    for outcome in report.outcomes:
        counts = (outcome.frames, outcome.correct, outcome.wrong, outcome.invalid)
        rows.append([outcome.influence, outcome.value, *counts, _reasons(outcome, " ", ":")])
    return _csv("influence value frames correct wrong invalid reasons", rows)


def _plot_errors(report: EcssReport, folder: Path) -> Path:
    from starid.storage.plots import figure, save

    shown = [line for line in report.all_lines if line.arcsec is not None]
    fig, axes = figure(height=3.6)
    heights = np.arange(len(shown))
    axes.barh(heights - 0.2, [line.across_arcsec for line in shown], 0.38, label="across the boresight")
    axes.barh(heights + 0.2, [line.about_arcsec for line in shown], 0.38, label="about the boresight")
    axes.set_yticks(heights, [line.name for line in shown])
    axes.invert_yaxis()
    axes.set_xlabel(f"arcseconds at {100 * report.confidence:g} %")
    axes.set_title(f"Attitude errors of {report.plan.profile}", parse_math=False)
    axes.legend()
    return folder / save(fig, folder / "ecss-errors.png")


def _plot_availability(report: EcssReport, folder: Path) -> Path:
    from starid.storage.plots import figure, save

    fig, axes = figure(2, 3, width=9.0, height=5.0, sharey=True)
    for axis, (name, (what, unit, _)) in zip(axes.flat, INFLUENCES.items(), strict=True):
        outcomes = [outcome for outcome in report.outcomes if outcome.influence == name]
        values = [outcome.value for outcome in outcomes]
        for what_of, mark, place in (("correct", "o", 0), ("wrong", "x", 1)):
            shares = np.array([100 * outcome.counts[place] / outcome.frames for outcome in outcomes])
            limits = 100 * np.array([interval(outcome.counts[place], outcome.frames) for outcome in outcomes])
            bars = np.abs(limits.T - shares)
            axis.errorbar(
                values, shares, bars, fmt=mark, markersize=4, capsize=2, linewidth=0.8, label=what_of
            )
        axis.set_xlabel(f"{what}, {unit}" if unit else what)
        axis.set_ylim(-3, 103)
        if max(values) > 20.0 * max(min(value for value in values if value > 0.0), 1e-9):
            least = min(value for value in values if value > 0.0)
            axis.set_xscale("symlog", linthresh=least)
            axis.set_xlim(-0.3 * least, 1.4 * max(values))
    axes.flat[0].legend()
    for row in axes:
        row[0].set_ylabel("% of frames")
    fig.suptitle(f"Probability of a correct and a wrong attitude, {report.plan.profile}", parse_math=False)
    return folder / save(fig, folder / "ecss-availability.png")
