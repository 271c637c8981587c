"""`starid features` and `starid database` as a user runs them."""

from __future__ import annotations

import json

import pytest
from typer.testing import CliRunner

from starid.cli.app import build_app
from starid.errors import StaridError

pytestmark = pytest.mark.long

runner = CliRunner()


def call(*arguments):
    return runner.invoke(build_app(arguments), list(arguments), catch_exceptions=True)


def test_published_features():
    result = call(
        "features",
        "--ra-corner",
        "95",
        "--dec-corner",
        "-85",
        "--kappa",
        "11.5",
        "--geometry",
        "planar",
        "--json",
    )
    values = json.loads(result.stdout)
    assert [round(values[k], 2) for k in ("n", "A", "r", "sigma_A", "sigma_r")] == [
        26,
        11.96,
        2.95,
        0.37,
        5.35,
    ]
    assert values["theta"] == pytest.approx(40.8, abs=0.1)


def test_build_and_info(tmp_path):
    file = tmp_path / "96.db"
    built = json.loads(call("database", "build", "--overlap", "96", "-o", str(file), "--json").stdout)
    assert (built["cells"], built["bytes_features"]) == (19_800, 99_000)
    assert built["seconds"] > 0.0
    info = json.loads(call("database", "info", str(file), "--json").stdout)
    assert (info["cells"], info["geometry"], info["kappa"]) == (19_800, "planar", 11.5)


def test_spherical_features_say_their_unit_and_have_the_defaults_of_a_database():
    result = call(
        *[
            "features",
            "--ra",
            "10",
            "--dec",
            "20",
            "--geometry",
            "spherical",
            "--kappa",
            "5",
            "--direction",
            "brightest",
            "--band",
            "v",
        ]
    )
    assert "px" in result.stdout
    assert result.stdout == call(*["features", "--ra", "10", "--dec", "20", "--geometry", "spherical"]).stdout


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("features",), "--ra and --dec"),
        (("features", "--ra", "1", "--dec", "95"), "declination"),
        (("features", "--ra", "1", "--dec", "5", "--geometry", "round"), "planar or spherical"),
        (("database", "build", "--overlap", "0.995"), "percent"),
        (("database", "info", "no-such-file"), "cannot be read"),
    ],
)
def test_what_is_rejected(arguments, words):
    result = call(*arguments)
    assert isinstance(result.exception, StaridError)
    assert words in str(result.exception)
