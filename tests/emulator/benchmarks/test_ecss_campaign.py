"""A small performance campaign with images: what is injected is found, and the report holds it."""

from __future__ import annotations

import csv
import json

import numpy as np
import pytest
from typer.testing import CliRunner

from starhil.emulator.benchmarks.ecss_campaign import INFLUENCES, EcssDevice, EcssPlan, run_part
from starhil.emulator.benchmarks.ecss_report import Stated, figure_names, interval
from starhil.emulator.benchmarks.ecss_requirements import read_requirements
from starhil.emulator.cli.app import build_app
from starhil.emulator.errors import EmulatorError

pytestmark = pytest.mark.long

SMALL = ["camera.width=320", "camera.height=320", "camera.fov_deg=30.0"]
DRIFT = ["sensor.boresight_drift_x=2.0", "sensor.boresight_drift_z=6.0", "thermal.swing_c=10.0"]
OPTIONS = ["--fields", "8", "--rest-frames", "20", "--frames", "5", "--seed", "4", "--json"]


def campaign(folder, *settings: str, options: tuple = (), status: int = 0) -> dict:
    chosen = [word for setting in (*SMALL, *settings) for word in ("--set", setting)]
    profile = folder / "a$_{`|<b>.toml"  # of which plots, tables and pages made markup
    profile.write_text(f'extends = "{PROFILE}"\n', encoding="utf-8")
    words = ["campaign", "--ecss", "--profile", str(profile), *OPTIONS, *options, *chosen, "-o", str(folder)]
    result = CliRunner().invoke(build_app(words), words)
    assert result.exit_code == status, result.output
    return json.loads(result.stdout)


PROFILE = "ideal"
LIMITS = """
requirement = [
    { id = "R1", figure = "thermo_elastic.x", max = 30.0, text = "drift along the orbit" },
    { id = "R2", figure = "thermo_elastic.z", max = 30.0, text = "<script>alert(1)</script> ![x](..) ![y](/etc/passwd) </td>" },
    { id = "R3", figure = "rest.correct", min = 99.0 },
    { id = "R4", figure = "rest.correct", min = 50.0 },
]
"""
"""Of 20 correct images of 20, the 95 % interval of the share ends at 83 %."""


def test_an_injected_drift_is_found_and_the_campaign_is_resumed(tmp_path):
    figures = campaign(tmp_path, *DRIFT)
    errors = figures["errors_arcsec"]
    thermal = errors["thermo-elastic error"]
    assert thermal["x"] == pytest.approx(20.0, rel=0.1)
    assert thermal["z"] == pytest.approx(60.0, rel=0.1)
    assert thermal["y"] == 0.0
    for other in ("bias", "field-of-view spatial error", "pixel spatial error"):
        assert max(errors[other]["x"], errors[other]["z"]) < 2.0, other
    largest_arcsec = 20.84  # v/c at the Earth's perihelion, 30.29 km/s
    residual = errors["aberration residual"]
    assert 0.9 * largest_arcsec < residual["across"]
    assert max(residual["x"], residual["y"]) < 1.01 * largest_arcsec
    assert (figures["availability"], figures["wrong"]) == (1.0, 0)

    report = (tmp_path / "report.md").read_text(encoding="utf-8")
    for what, _, values in INFLUENCES.values():
        assert f"## {what[0].upper()}{what[1:]}" in report
        assert values
    with (tmp_path / "errors.csv").open(encoding="utf-8") as stream:
        rows = {row["error"]: row for row in csv.DictReader(stream)}
    assert float(rows["thermo-elastic error"]["x_arcsec"]) == pytest.approx(thermal["x"], rel=1e-5)
    with (tmp_path / "availability.csv").open(encoding="utf-8") as stream:
        assert len(list(csv.DictReader(stream))) == 1 + sum(
            len(values) for _, _, values in INFLUENCES.values()
        )
    for plot in ("ecss-errors.png", "ecss-availability.png"):
        assert (tmp_path / plot).stat().st_size > 10_000

    kept = {file: file.stat().st_mtime_ns for file in (tmp_path / "parts").glob("*.npz")}
    next(file for file in kept if file.stem.startswith("rest")).unlink()
    limits = tmp_path / "limits.toml"
    limits.write_text(LIMITS, encoding="utf-8")
    again = campaign(tmp_path, *DRIFT, options=("--requirements", str(limits)), status=1)
    assert again["errors_arcsec"] == errors
    verdicts = {"R1": "met", "R2": "not met", "R3": "not shown", "R4": "met"}
    assert again["requirements"] == verdicts
    report = (tmp_path / "report.md").read_text(encoding="utf-8")
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    for text in (report, page):
        assert "SHA-256" in text
        assert "--requirements" in text
        for verdict in verdicts.values():
            assert verdict in text
    assert page.count("data:image/png;base64,") == 2
    assert "<script" not in page
    printed = (tmp_path / "report.pdf").read_bytes()
    assert printed.startswith(b"%PDF-")
    assert printed.count(b"/Subtype /Image") == 2
    assert printed.count(b"/Type /Page\n") >= 3
    unchanged = [file for file in kept if file.stat().st_mtime_ns == kept[file]]
    assert len(unchanged) == len(kept) - 1


def test_a_frame_depends_on_plan_and_number_only():
    plan = EcssPlan(PROFILE, tuple(SMALL), chunk=4, fields=3, positions=2, repeats=2)
    static = plan.conditions()[0]
    second = run_part(plan, static, 1)
    device = EcssDevice(plan)
    shots = [device.solve(static, number)[0] for number in range(4, 8)]
    assert second["labels"][:, :2].tolist() == [[1, 0], [1, 0], [1, 1], [1, 1]]
    assert [(shot.field_number, shot.condition_number) for shot in shots] == [(1, 0), (1, 0), (1, 1), (1, 1)]
    repeat = shots[0].attitude.error_to(shots[1].attitude).total_arcsec
    shift = shots[0].attitude.error_to(shots[2].attitude).total_arcsec
    pixel = 3600.0 * 30.0 / 320.0
    assert repeat == pytest.approx(0.0, abs=1e-6)
    assert 0.0 < shift < 0.8 * pixel


def test_an_interval_holds_the_share_and_ends_at_certainty():
    assert interval(0, 10_000) == (0.0, pytest.approx(3.69e-4, rel=0.01))
    assert interval(100, 100)[1] == 1.0
    low, high = interval(30, 100)
    assert (low, high) == (pytest.approx(0.212, abs=0.002), pytest.approx(0.400, abs=0.002))


def test_ecss_stands_alone_and_is_asked_for():
    app, runner = build_app(), CliRunner()
    assert runner.invoke(app, ["campaign"]).exit_code == 2
    assert runner.invoke(app, ["campaign", "--ecss", "lost-in-space", "--frames", "1"]).exit_code == 2
    wrong = runner.invoke(app, ["campaign", "--ecss", "--confidence", "99.7"])
    assert "0.997" in str(wrong.exception or wrong.output)


def test_stated_uncertainties_get_a_verdict():
    rng = np.random.default_rng(3)
    normal, stated = rng.normal(size=(2000, 2)), np.ones(2000)
    assert Stated.of("across", normal, stated).verdict == "consistent with the errors"
    assert Stated.of("across", normal, 0.7 * stated).verdict.startswith("**too small**: 96")
    assert Stated.of("across", normal, 1.3 * stated).verdict.startswith("larger than the errors")


def test_requirements_name_figures_of_the_report(tmp_path):
    file = tmp_path / "limits.toml"
    file.write_text(
        '[[requirement]]\nid = "A"\nfigure = "total.acros"\nmax = 1\n'
        '[[requirement]]\nid = "B"\nfigure = "rate.0.3.corect"\nmin = 1\n',
        encoding="utf-8",
    )
    with pytest.raises(EmulatorError) as error:
        read_requirements(file, figure_names())
    assert "A: no figure 'total.acros'; did you mean total.across" in str(error.value)
    assert "B: no figure 'rate.0.3.corect'; did you mean rate.0.3.correct" in str(error.value)
    file.write_text(
        '[[requirement]]\nid = "A"\nfigure = "total.across"\nmax = 1\nmin = 0\n', encoding="utf-8"
    )
    with pytest.raises(EmulatorError, match=r"limits\.toml: requirement\.A: .*give either min or max"):
        read_requirements(file, figure_names())
