"""Each error of a profile is one line, whatever keys it has."""

import pytest

from starhil.emulator.errors import EmulatorError
from starhil.emulator.profile import load_profile


@pytest.mark.parametrize("text", ['"k\\ney" = 1\n', '[truth]\nkind = "fixed"\n"k\\ney" = 1\n'])
def test_a_key_with_a_line_break_is_named_in_one_line(tmp_path, text):
    path = tmp_path / "profile.toml"
    path.write_text(text)
    with pytest.raises(EmulatorError, match=r"k\\ney: unknown key") as caught:
        load_profile(str(path))
    assert len(str(caught.value).splitlines()) == 1
