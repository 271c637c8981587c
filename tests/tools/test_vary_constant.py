"""Another value of a constant is compared on the same images, and the old one is put back."""

import importlib.util
import re
import sys
from pathlib import Path

from starid.imaging import peaks

_SPEC = importlib.util.spec_from_file_location(
    "vary_constant", Path(__file__).parents[2] / "tools" / "vary_constant.py"
)
vary_constant = importlib.util.module_from_spec(_SPEC)
sys.modules["vary_constant"] = vary_constant
_SPEC.loader.exec_module(vary_constant)


def test_less_room_for_peaks_finds_fewer_stars(monkeypatch, capsys):
    room = peaks._MAX_PEAKS
    monkeypatch.setattr(vary_constant, "SKIES", {"at rest": vary_constant.SKIES["at rest"]})
    words = ["vary_constant.py", "imaging.peaks._MAX_PEAKS", "16", str(room), "--images", "1"]
    monkeypatch.setattr(sys, "argv", words)
    vary_constant.main()
    total = capsys.readouterr().out.splitlines()[-1]
    found = [int(count) for count in re.findall(r"(\d+) +\d+ +[\d.]+ ms", total)]
    assert found[1] < 16 <= found[0] == found[2]
    assert room == peaks._MAX_PEAKS
