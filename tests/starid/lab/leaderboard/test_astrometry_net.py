"""astrometry.net's program behind the benchmark's interface: its files, its answers, and its absence."""

from __future__ import annotations

import math
import stat
import sys

import numpy as np
import pytest

from starid.attitude import Attitude
from starid.camera import Camera
from starid.lab.leaderboard import astrometry_net
from starid.lab.leaderboard.comparison import run

pytestmark = pytest.mark.long

CAMERA = Camera.from_fov(20.0, 512, 512)
AT = Attitude.from_radec_roll(83.0, -5.0, 0.0)
SCALE_DEG = math.degrees(1.0 / CAMERA.focal_px[0])
HEADER = {
    "CRVAL1": 83.0, "CRVAL2": -5.0, "CRPIX1": CAMERA.centre_px[0] + 1.0, "CRPIX2": CAMERA.centre_px[1] + 1.0,
    # north is up and east is left: the columns run west, the rows south
    "CD1_1": -SCALE_DEG, "CD1_2": 0.0, "CD2_1": 0.0, "CD2_2": -SCALE_DEG,
}  # fmt: skip
PROGRAM = """#!{python}
import sys
print("0.93")
cards = {cards!r}
if "--wcs" in sys.argv and {answers}:
    open(sys.argv[sys.argv.index("--wcs") + 1], "w").write(cards)
"""


def cards(header: dict[str, float]) -> str:
    lines = ["SIMPLE  =                    T", "CTYPE1  = 'RA---TAN'           / projection"]
    lines += [f"{key:<8}= {value:>20.13G} / a comment" for key, value in header.items()]
    return "".join(line.ljust(80) for line in [*lines, "END"])


@pytest.fixture
def program(tmp_path, monkeypatch):
    """Put a program in the place of solve-field that has an answer ready, or none."""

    def made(*, answers: bool) -> None:
        path = tmp_path / "bin" / astrometry_net.PROGRAM
        path.parent.mkdir()
        path.write_text(PROGRAM.format(python=sys.executable, cards=cards(HEADER), answers=answers))
        path.chmod(path.stat().st_mode | stat.S_IXUSR)
        monkeypatch.setenv("PATH", str(path.parent))

    return made


def test_the_attitude_is_that_of_the_projection() -> None:
    header = astrometry_net.read_header(cards(HEADER).encode())
    assert header == pytest.approx(HEADER, rel=1e-12)
    assert astrometry_net.attitude_of(header, CAMERA).error_to(AT).total_arcsec < 1e-3


def test_the_table_of_stars_counts_from_one_in_whole_blocks() -> None:
    xy, flux = np.array([[0.0, 5.5], [100.25, 511.0]]), np.array([3.0, 2.0])
    content = astrometry_net.star_table(xy, flux, CAMERA)
    assert len(content) % 2880 == 0
    header = astrometry_net.read_header(content[2880:])
    assert (header["NAXIS1"], header["NAXIS2"], header["IMAGEW"]) == (24.0, 2.0, 512.0)
    data = np.frombuffer(content[5760 : 5760 + 48], dtype=">f8").reshape(2, 3)
    np.testing.assert_array_equal(data, [[1.0, 6.5, 3.0], [101.25, 512.0, 2.0]])


@pytest.mark.parametrize("answers", [True, False])
def test_a_scene_gets_the_answer_of_the_program_or_none(program, tmp_path, answers) -> None:
    program(answers=answers)
    assert astrometry_net.installed()
    assert astrometry_net.version() == "0.93"
    found = astrometry_net.find_attitude(CAMERA, np.zeros((3, 2)), np.ones(3), tmp_path)
    assert (found is not None) == answers
    if found is not None:
        assert Attitude.from_matrix(found).error_to(AT).total_arcsec < 1e-3


def test_a_program_that_is_not_installed_is_left_out_with_the_remedy(monkeypatch, tmp_path) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    answer = run(1, 1, own=["solve-field"], rows=["0.5"])
    assert answer["rows"] == []
    assert "apt install astrometry.net" in answer["skipped"]["solve-field"]


@pytest.mark.skipif(not astrometry_net.installed(), reason="solve-field is not installed")
def test_the_program_itself_finds_the_field() -> None:
    (row,) = run(3, 1, own=["solve-field"], rows=["0.5"])["rows"]
    assert (row["valid_pct"], row["wrong"]) == (100.0, 0)
