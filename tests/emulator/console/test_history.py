"""The numbers of the last hour: bounded memory, and the newest rows."""

import math

import pytest

from starhil.emulator.console.history import COLUMNS, History

pytestmark = pytest.mark.long


def test_eight_hours_of_frames_keep_the_newest_hour_in_the_same_memory(bench):
    published = []
    bench.device.signals.frame_published.connect(published.append)
    assert bench.command("set_mode", mode="lost_in_space") == 0
    bench.step(2.0)
    history = History(kept=100)
    size = history._rows.nbytes
    for _ in range(800):
        row = history.add(published[-1])
    assert len(history) == 100
    kept = history.rows(range(history.start, history.end))
    assert kept.shape == (100, len(COLUMNS))
    assert history._rows.nbytes == size
    assert kept[-1].tolist() == row


def test_rows_come_oldest_first_whatever_their_number(bench):
    published = []
    bench.device.signals.frame_published.connect(published.append)
    bench.command("set_mode", mode="lost_in_space")
    bench.step(8.0)
    history = History(kept=5)
    for measurement in published[:7]:
        history.add(measurement)
    frames = history.rows(range(history.start, history.end))[:, COLUMNS.index("frame")].tolist()
    assert frames == [3, 4, 5, 6, 7]


def test_a_frame_without_attitude_has_no_errors_but_its_truth(bench):
    published = []
    bench.device.signals.frame_published.connect(published.append)
    bench.pipeline.fail = "no_match"
    bench.command("set_mode", mode="lost_in_space")
    bench.step(2.0)
    history = History()
    row = dict(zip(COLUMNS, history.add(published[-1]), strict=True))
    assert history.reasons == ["no_match"]
    assert math.isnan(row["error_cross"])
    assert math.isnan(row["qw"])
    assert row["true_ra"] == 83.8
    assert row["valid"] == 0
