"""The page on the architecture describes the run as it is."""

import asyncio
import inspect
import re
from pathlib import Path

import pytest

from starhil.emulator.device.signals import Signals
from starhil.emulator.profile import Profile
from starhil.emulator.run import Run
from tests.emulator.runs import FakeImager

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
LINE = re.compile(r"(?P<indent>[│├└─ ]*)(?:(?P<name>\w+): )?(?P<class>\w+) +(?P<file>[\w/]+\.py)")
OPTIONAL = {"feed": "truth", "stepper": "", "latest": "device", "warm": ""}
"""Attributes that a run need not have, which are None."""


def section(heading):
    return PAGE.partition(f"## {heading}\n")[2].partition("\n## ")[0]


def drawing():
    """Return the parts of the drawing: path of attributes, class and file."""
    block = section("A run, part by part").partition("```text\n")[2].partition("```")[0]
    parts, above = [], []
    for line in block.splitlines():
        match = LINE.fullmatch(line)
        assert match, line
        depth = len(match["indent"]) // 3
        above[depth:] = [match["name"]]
        parts.append((tuple(above[1:]), match["class"], match["file"]))
    return parts


@pytest.fixture
def opened(make_bench, monkeypatch):
    """Return what a function makes of a run with all links that has published a frame."""
    handle = make_bench().pipeline.handle
    monkeypatch.setattr("starhil.emulator.run.run.make_pipeline", lambda *_, **__: FakeImager(handle))

    def opened(look):
        links = {"serial": {"port": "auto"}, "can": {"channel": "virtual:drawn"}, "canopen": {"node": 5}}

        async def whole():
            run = Run([Profile.model_validate({"links": links, "run": {"clock": "stepped"}})])
            try:
                await run.open()
                return look(run)
            finally:
                await run.close()

        return asyncio.run(whole())

    return opened


def part_of(run, path):
    part = run
    for name in path:
        part = getattr(part, name)
        part = next(iter(part.values())) if name == "links" else part
        part = part[0] if isinstance(part, list) else part
    return part


def named(path, class_name, file):
    """Return the class that the drawing names, from its file."""
    module = __import__("starhil." + file.removesuffix(".py").replace("/", "."), fromlist=[class_name])
    return getattr(module, class_name)


def test_every_part_of_the_drawing_is_where_it_says(opened):
    def look(run):
        return [part_of(run, path) for path, _, _ in drawing()]

    for (path, class_name, file), part in zip(drawing(), opened(look), strict=True):
        drawn = named(path, class_name, file)
        assert Path(inspect.getsourcefile(drawn)).resolve() == (ROOT / file).resolve()
        if path and path[-1] in OPTIONAL and part is None:
            continue
        same_kind = type(part).__module__ == drawn.__module__ or type(part) is FakeImager
        assert isinstance(part, drawn) or same_kind, path


def test_the_drawing_leaves_no_part_out(opened):
    """Every public attribute of run, head and device whose class is defined in the emulator or the protocol."""
    drawn = {path for path, _, _ in drawing()}
    shared = {"wiring", "truth", "clock", "profile"}

    def look(run):
        missing = set()
        for path in ((), ("heads",), ("heads", "device")):
            for name, value in vars(part_of(run, path)).items():
                is_part = type(value).__module__.startswith("starhil.")
                if (
                    is_part
                    and not name.startswith("_")
                    and name not in shared | {"icd"}
                    and (*path, name) not in drawn
                ):
                    missing.add((*path, name))
        return missing

    assert opened(look) == set()


def test_every_signal_has_its_sender_and_its_observers_in_the_drawing():
    from starhil.emulator.device import signals

    for name in Signals.__dataclass_fields__:
        assert f"──{name}──►" in signals.__doc__


def changes():
    """Return the items of the list of changes: what is new, the files, and the names that stand in them."""
    items = re.findall(r"^- \*\*(.*?)\*\*: (.*\n(?:  .*\n)*)", section("What to change for"), re.MULTILINE)
    for new, files in items:
        quoted = set(re.findall(r"`([^`]+)`", files))
        paths = {text for text in quoted if "/" in text}
        names = {text for text in quoted - paths if text.isidentifier()}
        yield new, paths, names


def test_the_list_of_changes_names_what_stands_in_its_files():
    rows = list(changes())
    assert len(rows) >= 12
    for new, paths, names in rows:
        files = [file for path in paths for file in ([ROOT / path, *(ROOT / path).glob("*.py")])]
        text = "".join(file.read_text(encoding="utf-8") for file in files if file.is_file())
        for name in names:
            assert re.search(rf"\b{name}\b", text), (new, name)


def test_the_way_of_a_telecommand_visits_no_file_twice():
    steps = re.findall(r"^\d+\. `([\w/.]+\.py)`", section("The way of a telecommand"), re.MULTILINE)
    assert 0 < len(steps) == len(set(steps)) <= 7
    assert all((ROOT / file).is_file() for file in steps)
