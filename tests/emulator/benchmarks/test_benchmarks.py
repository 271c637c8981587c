"""The benches of centroids and frames measure what they say."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from starhil.emulator.benchmarks.centroid import cramer_rao_px, measure_centroids
from starhil.emulator.benchmarks.frame import measure_bodies, measure_frames
from starhil.emulator.cli.app import main
from starhil.emulator.errors import EmulatorError
from starhil.emulator.sensor.model import SensorModel

pytestmark = pytest.mark.long


def run(monkeypatch: pytest.MonkeyPatch, *arguments: str) -> int:
    monkeypatch.setattr("sys.argv", ["starhil", "bench", *arguments])
    with pytest.raises(SystemExit) as caught:
        main()
    return int(caught.value.code or 0)


def test_the_bound_of_a_sampled_gaussian() -> None:
    """Of a finely sampled spot the bound has closed forms: photon limit σ/√N, sky limit σ²·√(8π)·noise/N."""
    sensor = SensorModel(prnu=0.0, full_well_e=1e7, adc_range_e=1e7)
    place = np.array([100.3, 200.6])
    photons = cramer_rao_px(place, 1e5, 3.0, (0.0, 0.0), 1e-3, sensor, 0.0)
    assert photons == pytest.approx((3.0 / np.sqrt(1e5),) * 2, rel=0.02)
    sky = cramer_rao_px(place, 10.0, 3.0, (0.0, 0.0), 1e4, sensor, 0.0)
    assert sky == pytest.approx((3.0**2 * np.sqrt(8.0 * np.pi) * 100.0 / 10.0,) * 2, rel=0.02)


def test_centroids_are_at_their_bound() -> None:
    rows = [row for row in measure_centroids((0.0, 1.0), frames=3, seed=2) if row.v_low >= 4.5]
    assert {row.rate_deg_s for row in rows} == {0.0, 1.0}
    for row in rows:
        spread = 5.0 / np.sqrt(4.0 * row.stars)
        assert row.ratio == pytest.approx(1.0, abs=spread + 0.05)
        assert row.normalised_squared_error == pytest.approx(1.0, abs=2.0 * spread + 0.05)
        assert row.predicted_px == pytest.approx(row.bound_px, rel=0.1)
        assert row.detected_pct > 97.0


def test_the_centroid_bench_as_json_and_as_a_plot(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    plot = tmp_path / "centroids.png"
    assert run(monkeypatch, "centroid", "--rate", "0", "--frames", "1", "--json", "-o", str(plot)) == 0
    answer = json.loads(capsys.readouterr().out)
    assert {"v_low", "v_high", "rms_px", "bound_px", "ratio"} <= answer["rows"][0].keys()
    assert plot.read_bytes().startswith(b"\x89PNG")


def test_frames_are_timed_stage_by_stage() -> None:
    rows = {row.stage: row for row in measure_frames(frames=3)}
    assert list(rows) == ["render", "detect", "identify", "all"]
    assert all(0.0 < row.least_ms <= row.median_ms <= row.p99_ms for row in rows.values())
    assert rows["all"].least_ms > rows["render"].least_ms


def test_frames_with_bodies_are_timed_against_those_without() -> None:
    rows = measure_bodies(frames=2)
    assert [(row.in_field, row.stage) for row in rows] == [
        (body, stage) for body in ("none", "earth", "moon") for stage in ("render", "all")
    ]
    assert all(row.frames == 2 and row.ratio == row.with_ms / row.without_ms for row in rows)


@pytest.mark.parametrize("call", [lambda: measure_centroids(frames=0), lambda: measure_frames(frames=0)])
def test_no_frames_are_rejected(call: object) -> None:
    with pytest.raises(EmulatorError, match="must be at least one"):
        call()  # type: ignore[operator]
