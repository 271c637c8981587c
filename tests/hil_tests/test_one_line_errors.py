"""Each error of a session script is one line, whatever names it quotes."""

import pytest

from starhil.hil_tests.errors import ScriptError
from starhil.hil_tests.session.script import load_script
from starhil.protocol.unit import load_unit


@pytest.mark.parametrize("row", ["quater\\nnion", "quaternion\\u2028"])
def test_an_unknown_row_with_a_line_break_is_named_in_one_line(tmp_path, row):
    path = tmp_path / "session.toml"
    path.write_text(2 * f'[[step]]\nname = "s"\nread = "{row}"\n')
    with pytest.raises(ScriptError, match="no telemetry row named") as caught:
        load_script(path, load_unit("cubestar"))
    assert [len(text.splitlines()) for text in (str(caught.value), *caught.value.problems)] == [1, 1, 1]
