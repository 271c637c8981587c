"""The ready line comes when a frame can be solved."""

from __future__ import annotations

import asyncio

import pytest

from tests.emulator.runs import FakeImager


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


def test_a_start_rehearses_a_frame_with_the_parameters(run, prepared):
    async def scenario(emulation, _line):
        request = prepared[0]
        assert request.settings.focal_length == emulation.device.parameters["focal_length"]
        assert request.rehearsal.exposure_s == emulation.device.cycle.exposure_s
        assert request.rehearsal.truth.attitude.ra_deg == pytest.approx(83.8)
        assert len(prepared) == 1

    run(scenario, clock="real")


def test_the_symlink_to_the_port_is_made_when_the_unit_answers(run, prepared, tmp_path, monkeypatch):
    """A session found it minutes before, while kernels were compiled, and met a unit that went on booting."""
    link, before = tmp_path / "tty", []
    link.symlink_to("/dev/pts/99999")
    settle = FakeImager.settle

    async def settled(self):
        await settle(self)
        before.extend(tmp_path.iterdir())

    async def scenario(_emulation, line):
        assert f"serial={link} " in line
        assert link.readlink().exists()

    monkeypatch.setattr(FakeImager, "settle", settled)
    run(scenario, clock="real", links={"serial": {"port": "auto", "symlink": str(link)}})
    assert before == []
