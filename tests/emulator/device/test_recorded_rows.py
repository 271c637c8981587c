"""The CubeStar's rows have the bytes that were recorded before rows were bound to quantities in data."""

from pathlib import Path

from tests.emulator.device.recorded_run import recording


def test_every_row_has_the_recorded_bytes_in_every_state():
    recorded = Path(__file__).with_name("recorded_rows.txt").read_text(encoding="ascii").splitlines()
    assert list(recording()) == recorded
