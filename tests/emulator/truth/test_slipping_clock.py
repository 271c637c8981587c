"""A live feed whose clock is a little fast or slow is followed for a minute."""

import math

import numpy as np
import pytest

from starhil.emulator.truth.live import LiveTruth
from starhil.emulator.truth.source import TruthStatus
from tests.emulator.truth.test_truth import EAST, SLEW, apart_arcsec, line

pytestmark = pytest.mark.long


@pytest.mark.parametrize("with_rate", [True, False])
@pytest.mark.parametrize("speed", [0.9, 0.978, 1.001, 1.1])
def test_a_sender_whose_clock_slips_is_followed(speed, with_rate):
    live = LiveTruth(EAST, stale_s=1.0)
    rng = np.random.default_rng(1)
    worst_arcsec = worst_lag_s = 0.0
    for n in range(600):
        t = 0.1 * n
        received = t / speed + rng.exponential(0.002)
        truth = SLEW.state(t)
        rate = np.degrees(truth.rate_rad_s).tolist() if with_rate else None
        assert live.receive(line(1e6 + t, truth.attitude, rate), received), live.last_fault
        for later in (0.0, 0.05, 0.09):
            state = live.state(received + later)
            assert state.status in {TruthStatus.OK, TruthStatus.EXTRAPOLATED}
            if n > 100:
                there = SLEW.state(speed * (received + later)).attitude
                worst_arcsec = max(worst_arcsec, apart_arcsec(state.attitude, there))
            if later == 0.0 and n > 100 and np.linalg.norm(truth.rate_rad_s) > math.radians(0.5):
                behind = apart_arcsec(state.attitude, truth.attitude)
                worst_lag_s = max(worst_lag_s, behind / 3600 / 0.5)
    # the line lags by the slip of a window or two
    assert worst_lag_s < 0.05 + 8.0 * abs(1.0 / speed - 1.0)
    assert worst_arcsec < 0.8 * 3600 * (0.05 + 8.0 * abs(1.0 / speed - 1.0))
