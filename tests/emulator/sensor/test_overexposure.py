"""Overexposed pixels: charge is conserved where it spills, and traps release it by an exponential law; both cost stars."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from starhil.emulator.profile import load_profile
from starhil.emulator.profile.pipeline_setup import pipeline_setup
from starhil.emulator.sensor.model import SensorModel
from starhil.emulator.sensor.overexposure import Afterimage, spill
from starhil.emulator.sensor.pipeline.messages import FrameRequest
from starhil.emulator.sensor.pipeline.pipeline import Pipeline
from starhil.emulator.sensor.renderer import Renderer
from starhil.emulator.sensor.sky.objects import PointSource, SkyObjects
from starhil.emulator.truth.source import ZERO_RATE, TruthState
from starid.attitude import Attitude
from starid.camera import Camera
from starid.catalog import load_catalog

WELL_E = 10_000.0
ORION = Attitude.from_radec_roll(83.8, -1.2, 0.0)


@pytest.fixture(scope="module")
def renderer():
    """A camera of 20° on a dark, quiet detector with a large well."""
    sensor = SensorModel(
        hot_pixels=0, dead_pixels=0, prnu=0.0, dsnu=0.0, read_noise_e=0.0, bits=16, adc_range_e=30_000.0
    )
    return Renderer(Camera.from_fov(20.0, width=400, height=400), load_catalog(), sensor, 5)


@pytest.mark.parametrize("share", [1.0, 0.3])
def test_what_spills_is_all_that_is_beyond_the_well_less_what_is_drained(share):
    """A spot of 60 wells in three columns over a sky of a tenth of the well: each pixel takes nine tenths."""
    rng = np.random.default_rng(3)
    before = rng.uniform(0.0, 0.2 * WELL_E, (301, 80)).astype(np.float32)
    before[150, 40:43] += np.float32(20.0 * WELL_E)
    after = before.copy()
    spill(after, WELL_E, share)
    excess = np.maximum(before.astype(np.float64) - WELL_E, 0.0).sum()
    assert after.sum(dtype=np.float64) == pytest.approx(
        before.sum(dtype=np.float64) - (1.0 - share) * excess, rel=1e-6
    )
    assert after.max() <= WELL_E
    assert np.array_equal(np.delete(after, range(40, 43), axis=1), np.delete(before, range(40, 43), axis=1))
    full = np.flatnonzero(after[:, 41] == np.float32(WELL_E))
    assert np.array_equal(full, np.arange(full[0], full[-1] + 1))
    assert full.size == pytest.approx(1.0 + share * 19.0 / 0.9, abs=2.0)
    assert abs((full[0] + full[-1]) / 2.0 - 150.0) <= 1.0


def test_what_reaches_the_edge_leaves_the_image():
    image = np.zeros((11, 5), dtype=np.float32)
    image[2, 2] = 9.0 * WELL_E
    spill(image, WELL_E, 1.0)
    assert image[:, 2] == pytest.approx([WELL_E] * 7 + [0.0] * 4)  # two of four wells find place above


def test_traps_release_their_charge_by_an_exponential_law_however_time_is_divided():
    decay_s, capacity_e = 2.5, 500.0
    for ends in (np.arange(0.1, 20.1, 0.1), np.array([0.7, 3.0, 3.1, 9.0, 20.0])):
        afterimage, begin_s, released = Afterimage(WELL_E, capacity_e, decay_s), 1.0, []
        full = np.array([[2.0 * WELL_E, 0.9 * WELL_E]], dtype=np.float32)
        afterimage.expose(full, 0.5, begin_s)
        assert full.tolist() == [[np.float32(2.0 * WELL_E), np.float32(0.9 * WELL_E)]]
        for end_s in 1.0 + ends:
            mean = np.zeros((1, 2), dtype=np.float32)
            afterimage.expose(mean, begin_s, end_s)
            released.append(mean[0, 0])
            assert mean[0, 1] == 0.0
            begin_s = end_s
        left = np.exp(-np.concatenate([[0.0], ends]) / decay_s)
        assert released == pytest.approx(capacity_e * -np.diff(left), rel=1e-4, abs=0.02)


def test_between_exposures_charge_is_released_too():
    afterimage = Afterimage(WELL_E, 800.0, 1.0)
    afterimage.expose(np.full((1, 1), 2.0 * WELL_E, dtype=np.float32), 0.0, 1.0)
    mean = np.zeros((1, 1), dtype=np.float32)
    afterimage.expose(mean, 3.0, 3.5)
    assert mean[0, 0] == pytest.approx(800.0 * (math.exp(-2.0) - math.exp(-2.5)), rel=1e-5)


def test_a_bright_object_leaves_a_spot_where_it_was(renderer):
    """Venus beside Orion, which the sensor then turns away from by 3°."""
    capacity_e, decay_s, exposure_s = 3000.0, 1.0, 0.2
    venus = SkyObjects(planets=(PointSource(84.0, -1.0, -4.4, "Venus"),))
    turned = ORION.rotated((math.radians(3.0), 0.0, 0.0))
    afterimage = Afterimage(renderer.sensor.full_well_e, capacity_e, decay_s)
    seen = renderer.render(ORION, objects=venus, exposure_s=exposure_s, afterimage=afterimage, begin_s=0.0)
    places = seen.objects.planet_xy_px[0]
    column, row = np.rint(places).astype(int)
    spot = seen.image[row - 1 : row + 2, column - 1 : column + 2]
    assert (spot == renderer.sensor.saturation_dn).all() or (
        spot >= 0.9 * renderer.sensor.saturation_dn
    ).all()
    with_spot = renderer.render(
        turned, frame_index=1, exposure_s=exposure_s, afterimage=afterimage, begin_s=0.4
    )
    without = renderer.render(turned, frame_index=1, exposure_s=exposure_s)
    part = np.s_[row - 1 : row + 2, column - 1 : column + 2]
    extra_e = (
        with_spot.image[part].astype(float) - without.image[part]
    ).mean() * renderer.sensor.gain_e_per_dn
    expected_e = capacity_e * (math.exp(-0.2) - math.exp(-0.4))
    assert extra_e == pytest.approx(expected_e, abs=3.0 * math.sqrt(2.0 * expected_e / 9.0))


def requests(setup, states, sky):
    """Return requests of contiguous exposures of 0.1 s at attitudes, the first two with another sky."""
    return [
        FrameRequest(
            index,
            TruthState(truth, ZERO_RATE),
            0.1,
            1.0,
            setup.settings,
            faults=sky if index < 2 else {},
            begin_s=0.1 * index,
            pipeline_starts=1,
        )
        for index, truth in enumerate(states)
    ]


DAZZLED = ["sensor.persistence_share=1.0", "sensor.persistence_s=0.4"]


@pytest.fixture(scope="module")
def setups():
    return {
        name: pipeline_setup(load_profile("ideal", keys))
        for name, keys in (("with", DAZZLED), ("without", []))
    }


@pytest.mark.long
def test_after_dazzling_stars_are_missing_for_seconds_and_no_attitude_is_wrong(setups):
    sun = {"sun": {"ra_deg": 84.0, "dec_deg": -1.0, "exclusion_deg": 20.0}}
    truths = [ORION.rotated((0.0, 0.0, 0.01 * k)) for k in range(40)]
    results = {}
    for name, setup in setups.items():
        pipeline = Pipeline(setup)
        results[name] = [pipeline.handle(request) for request in requests(setup, truths, sun)]
        for result, truth in zip(results[name], truths, strict=True):
            assert not result.valid or (
                Attitude(np.array(result.quaternion_xyzw)).error_to(truth).total_arcsec < 60.0
            )
    counts = {name: np.array([result.detected for result in each]) for name, each in results.items()}
    assert not any(result.valid for result in results["with"][:2])
    assert counts["with"][2] < 0.7 * counts["without"][2]
    assert (np.diff(counts["with"][[2, 3, 4, 6, 8]]) > 0).all()
    light = {name: np.array([result.background_dn for result in each]) for name, each in results.items()}
    glow = (light["with"] - light["without"])[2:9]
    assert glow[1:] / glow[:-1] == pytest.approx(math.exp(-0.1 / 0.4), rel=0.05)
    assert counts["with"][35] == pytest.approx(counts["without"][35], rel=0.05)


def test_images_with_an_afterimage_are_repeated_and_one_that_is_taken_by_itself_has_none(setups):
    sun = {"sun": {"ra_deg": 84.0, "dec_deg": -1.0, "exclusion_deg": 20.0}}
    setup = setups["with"]
    frame_requests = requests(setup, [ORION] * 4, sun)
    first, again, alone = Pipeline(setup), Pipeline(setup), Pipeline(setup)
    wanted = [first.handle(request).background_dn for request in frame_requests]
    assert [again.handle(request).background_dn for request in frame_requests] == wanted
    bare = alone.handle(replace(frame_requests[2], begin_s=None)).background_dn
    assert wanted[2] > bare + 5.0
    restarted = [replace(request, pipeline_starts=2) for request in frame_requests[2:3]]
    assert first.handle(restarted[0]).background_dn == pytest.approx(bare, abs=0.5)
