"""The database: published sizes, codes against full precision, the file, rejection of bad input."""

from __future__ import annotations

import dataclasses
import struct

import numpy as np
import pytest

from starid.camera import Camera
from starid.identification.thesis.database import CODE_MAX, DatabaseError, DatabaseParameters, build_database
from starid.identification.thesis.database_file import MAGIC, load_database, save_database
from starid.identification.thesis.frame_grid import (
    GridError,
    circle_intrusion,
    make_grid,
    minimum_overlap,
    nominal_cells,
)
from tests.starid.identification.thesis.thesis_sky import database, thesis_catalog

pytestmark = pytest.mark.long

CODE_STEP = 100.0 / CODE_MAX
HALF_A_CODE = 0.5 * CODE_STEP * (1.0 + 1e-9)


@pytest.mark.parametrize(
    ("percent", "cells", "kilobytes"),
    [
        (96.0, 19_800, 99),
        (97.0, 35_100, 176),
        (99.0, 315_000, 1_575),
        (99.1, 389_000, 1_945),
        (99.2, 492_750, 2_464),
        (99.4, 876_000, 4_380),
        (99.5, 1_260_000, 6_300),
        (99.75, 5_040_000, 25_200),
    ],
)
def test_published_sizes(percent, cells, kilobytes):
    grid = make_grid("planar", 40.0, percent / 100.0)
    assert grid.cells == cells
    assert round(5 * grid.cells / 1000 + 1e-9) == pytest.approx(kilobytes, abs=0.51)


def test_nominal_number_and_least_overlap():
    assert int(nominal_cells(42.0, 0.96)) == 22_959
    assert minimum_overlap() == pytest.approx(0.2929, abs=5e-5)
    x = circle_intrusion(1.0)
    assert 2.0 * (2.0 - x) ** 2 == pytest.approx(4.0)


def test_published_dictionary():
    grid = make_grid("planar", 40.0, 0.96)
    assert (grid.dictionary(734) + 1).tolist() == [509, 510, 511, 734, 735, 736, 959, 960, 961]
    ra, dec = grid.centre(734)
    assert (ra - 20.0, dec - 20.0) == pytest.approx((94.4, -85.2))


@pytest.mark.parametrize("geometry", ["planar", "spherical"])
def test_every_dictionary_is_nine_different_neighbours(geometry):
    grid = make_grid(geometry, 40.0, 0.95)
    for cell in {0, 1, int(grid.row_start[1]) - 1, grid.cells // 2, grid.cells - 1, grid.cells - 2}:
        cells = grid.dictionary(cell)
        assert cell in cells
        assert len(set(cells.tolist())) == 9
        assert cells.min() >= 0
        assert cells.max() < grid.cells


def test_spherical_cells_are_similar_in_area_and_reach_the_poles():
    grid = make_grid("spherical", 42.0, 0.99)
    area = 360.0 / grid.row_columns * np.cos(np.radians(grid.row_dec_deg)) * 180.0 / grid.rows
    inner = grid.row_columns > 30
    assert area[inner].std() / area[inner].mean() < 0.02
    assert grid.row_dec_deg[0] < -89.7


def test_stored_codes_are_within_half_a_step_of_the_exact_features():
    made = database(96.0)
    rng = np.random.default_rng(1)
    for cell in rng.integers(made.cells, size=200):
        exact = made.normalise(made.exact_features(int(cell)))
        assert np.abs(exact - CODE_STEP * made.features[cell]).max() <= HALF_A_CODE


def test_threads_and_progress_do_not_change_the_result():
    sizes = []
    parameters = DatabaseParameters(overlap=0.9)
    one = build_database(thesis_catalog(), parameters, threads=1, progress=lambda a, b: sizes.append((a, b)))
    three = build_database(thesis_catalog(), parameters, threads=3)
    np.testing.assert_array_equal(one.features, three.features)
    np.testing.assert_array_equal(one.theta, three.theta)
    assert sizes[-1] == (2 * one.cells, 2 * one.cells)


def test_spherical_features_do_not_depend_on_the_pole():
    camera = Camera.from_fov(42.0)
    parameters = DatabaseParameters.for_camera(camera, overlap=0.97, kappa=5.0)
    made = build_database(thesis_catalog(), parameters)
    assert made.parameters.half_width == pytest.approx(468.5)
    assert (made.theta != 255).all()


def test_a_saved_database_is_loaded_unchanged(tmp_path):
    made = database(96.0)
    path = tmp_path / "96.db"
    assert save_database(made, path) == path.stat().st_size
    back = load_database(path)
    np.testing.assert_array_equal(back.features, made.features)
    np.testing.assert_array_equal(back.theta, made.theta)
    np.testing.assert_array_equal(back.sky.stars, made.sky.stars)
    assert back.parameters == made.parameters
    assert back.catalog_identity == made.catalog_identity
    assert back.exact_features(734) == made.exact_features(734)


def test_bad_files_are_rejected_by_name(tmp_path):
    path = tmp_path / "good.db"
    save_database(database(96.0), path)
    whole = path.read_bytes()
    cases = {
        "cannot be read": None,
        "is not a feature database": b"something else entirely",
        "truncated": whole[:-1],
        "has a truncated header": whole[: len(MAGIC) + 10],
        "is damaged": whole[:5000] + bytes([whole[5000] ^ 1]) + whole[5001:],
        "damaged header": whole[:25] + b"#" + whole[26:],
        "has a damaged header": MAGIC + struct.pack("<I", 9000) + b"[" * 9000,
    }
    for number, (words, content) in enumerate(cases.items()):
        bad = tmp_path / f"bad{number}.db"
        if content is not None:
            bad.write_bytes(content)
        with pytest.raises(DatabaseError, match=words) as caught:
            load_database(bad)
        assert str(bad) in str(caught.value)


@pytest.mark.parametrize("overlap", [1.0, -0.1, float("nan"), 99.5])
def test_an_overlap_outside_its_range_is_rejected(overlap):
    with pytest.raises(GridError, match="overlap"):
        make_grid("planar", 40.0, overlap)


def test_a_header_with_other_parameters_is_rejected():
    values = dataclasses.asdict(DatabaseParameters())
    del values["kappa"]
    with pytest.raises(DatabaseError, match="parameters"):
        DatabaseParameters.from_dict(values)
