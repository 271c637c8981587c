"""The tutorial of a unit: its files have no errors, its exchange is the one shown, its client reads the truth."""

from __future__ import annotations

import asyncio

from typer.testing import CliRunner

from starhil.emulator.cli.app import build_app
from starhil.emulator.emulation import Emulation
from starhil.emulator.launch import Run, RunOptions
from starhil.emulator.profile import Profile
from tests.emulator.conftest import FakePipeline
from tests.emulator.runs import FakeImager
from tests.test_docs import blocks, programs, run

PAGE = "your-unit.md"


def written(folder):
    """Write the unit of the page into a folder."""
    folder.mkdir()
    text = "\n".join(block.text for block in blocks(PAGE) if block.language == "toml")
    (folder / "unit.toml").write_text(text, encoding="utf-8")
    return folder


def test_the_unit_of_the_page_has_no_errors_and_the_exchange_that_is_shown(tmp_path):
    result = CliRunner().invoke(build_app(), ["unit", "check", str(written(tmp_path / "lynx"))])
    assert result.exit_code == 0, result.output
    shown = next(block for block in blocks(PAGE) if block.heading == "Check it" and block.language == "text")
    example, end = shown.text.split("…\n")
    assert example in result.stdout
    assert result.stdout.endswith(end.replace("lynx", str(tmp_path / "lynx")))


def test_the_client_of_the_page_prints_the_output_shown(tmp_path, monkeypatch):
    monkeypatch.setattr(Emulation, "_make_imager", lambda *_: FakeImager(FakePipeline().handle))
    profile = Profile.model_validate(
        {
            "unit": str(written(tmp_path / "lynx")),
            "links": {"can": {"channel": "off"}},
            "truth": {"kind": "fixed", "attitude": {"ra_deg": 83.8, "dec_deg": -1.2, "roll_deg": 0.0}},
            "health": {"temperature": 21.5},
        }
    )
    ((client, printed),) = programs(PAGE)

    async def read() -> str:
        emulator = Run(profile, RunOptions())
        try:
            await emulator.start()
            await emulator.emulation.ready()
            port = emulator.emulation.ready_fields["serial"]
            return await asyncio.to_thread(run, client, {"PORT": port})
        finally:
            await emulator.close()

    assert asyncio.run(read()) == printed
