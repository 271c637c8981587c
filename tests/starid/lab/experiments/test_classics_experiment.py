"""The competitors' experiment: its two skies against the thesis's frames, and a run with its report."""

import numpy as np
import pytest

from starid.lab.classic.registry import make_identifier
from starid.lab.experiments import registry, runner
from starid.lab.experiments.classics_sky import thesis_sky
from starid.lab.simulation import NoiseModel

pytestmark = pytest.mark.long

DEGREE = 1.0
PIXEL = 42.0 / 937.0
FRAMES = [(22.0, 12.0), (332.0, -38.0), (180.0, 62.0), (22.0, -68.0)]


@pytest.mark.parametrize("name", ["flat", "sphere"])
def test_frames_contain_the_stars_of_the_catalogue(name):
    sky = thesis_sky(name)
    solver = make_identifier(
        "oriented-svd",
        sky.camera,
        sky.catalog,
        verify=False,
        zero_point=0.0,
        stars_per_field=25.0,
        limiting_magnitude=sky.limit_for(25.0),
    )
    for ra, dec in FRAMES:
        xy, flux = sky.observe(np.random.default_rng(1), ra, dec, NoiseModel())
        solution = solver.identify(xy, flux, np.full(len(flux), 0.1))
        assert solution.valid
        found = sky.boresight_deg(solution.attitude)
        assert abs((found[0] - ra + 180.0) % 360.0 - 180.0) * np.cos(np.radians(dec)) < PIXEL
        assert abs(found[1] - dec) < PIXEL
        assert solution.rms_px < 0.5


def test_flat_frames_have_the_thesis_number_of_stars_on_its_scale():
    sky = thesis_sky("flat")
    counts = [len(sky.observe(np.random.default_rng(0), ra, dec, NoiseModel())[1]) for ra, dec in FRAMES]
    assert counts == [len(sky.frames.stars_in_frame(ra, dec)[0]) for ra, dec in FRAMES]
    xy, _ = sky.observe(np.random.default_rng(0), *FRAMES[2], NoiseModel(false_stars=5))
    assert np.hypot(*(xy - sky.camera.centre_px).T).max() <= 20.0 * DEGREE / PIXEL + 1e-9


def test_the_experiment_prints_published_beside_ours(tmp_path, monkeypatch):
    import dataclasses

    experiment = registry.experiments()["classics"]
    parameters = {
        "algorithms": ["pyramid", "match-group", "geometric"],
        "skies": ["flat", "sphere"],
        "cases": ["none", "false-1"],
        "every": 425,
    }
    small = dataclasses.replace(experiment, full=parameters)
    outcome = runner.run([small], tmp_path, jobs=1)[0].outcome
    assert not outcome.failed
    rows = {row.quantity: row for row in outcome.rows}
    assert rows["PA, the thesis's flat sky, no noise: identified"].published == "99.34 %"
    assert rows["PA, the thesis's flat sky, no noise: identified"].passed
    assert rows["geometric (ours), the same stars on the sphere, no noise: identified"].passed
    assert rows["PA: database"].published == "131 kB"
    assert "12° sensor" in rows["PA: database"].remark
    assert (tmp_path / "classics" / "figure_6_11_classics.png").read_bytes().startswith(b"\x89PNG")
    assert "geometric (ours), the thesis's flat sky, no noise: identified" not in rows
