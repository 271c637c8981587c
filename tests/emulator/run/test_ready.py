"""The ready line comes when a frame can be solved; what nobody could foresee holds simulation time."""

from __future__ import annotations

import asyncio

import pytest

from starhil.emulator.launch import RunOptions
from tests.emulator.runs import Control, FakeImager
from tests.waiting import PATIENCE_S

MOON = {"moon": {"ra_deg": 80.0, "dec_deg": 0.0}}
SCENARIO = """
[[at]]
run_time_s = 5.0
fault = { optical = { moon = { ra_deg = 80.0, dec_deg = 0.0 } } }
"""


@pytest.fixture
def prepared(monkeypatch):
    """The requests to prepare the pipeline; each takes a moment of wall time."""
    requests = []
    pending = asyncio.Event

    def prepare(self, request):
        requests.append(request)
        self.slow = pending()
        asyncio.get_running_loop().call_later(0.3, self.slow.set)

    async def settle(self):
        if getattr(self, "slow", None) is not None:
            await self.slow.wait()

    monkeypatch.setattr(FakeImager, "prepare", prepare)
    monkeypatch.setattr(FakeImager, "settle", settle)
    return requests


def test_a_start_rehearses_frames_with_parameters_sky_and_scenario(run, prepared, tmp_path):
    path = tmp_path / "moon.toml"
    path.write_text(SCENARIO)

    async def scenario(emulation, _line):
        request = prepared[0]
        assert [frame.faults for frame in request.rehearsals] == [{}, MOON]
        assert request.settings.focal_length == emulation.device.parameters["focal_length"]
        assert request.rehearsals[0].exposure_s == emulation.device.cycle.exposure_s
        assert (request.rehearsals[0].truth.attitude).ra_deg == pytest.approx(83.8)
        assert len(prepared) == 1

    run(scenario, clock="real", options=RunOptions(control="auto", scenario=str(path)))


def test_time_stands_while_the_pipeline_prepares_for_a_sky_that_nobody_foresaw(run, prepared):
    async def scenario(emulation, _line):
        loop = asyncio.get_running_loop()
        async with Control(emulation) as control:
            before_s, begun_s = (await control.do("status"))["run_time_s"], loop.time()
            assert (await control.do("fault", optical=MOON))["ok"]
            passed_s = (await control.do("status"))["run_time_s"] - before_s
            taken_s = loop.time() - begun_s
            assert [frame.faults for frame in prepared[-1].rehearsals] == [MOON]
            assert taken_s > 0.29
            assert passed_s < taken_s - 0.25
            count = len(prepared)
            assert (await control.do("fault", optical=MOON))["ok"]
            assert len(prepared) == count  # known now
            async with asyncio.timeout(PATIENCE_S):
                while (await control.do("status"))["run_time_s"] <= before_s + passed_s:
                    pass

    run(scenario, clock="real")
