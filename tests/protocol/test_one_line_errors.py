"""Each error of a definition is one line, whatever text of the definition it quotes."""

import pytest

from starhil.protocol.errors import IcdError
from starhil.protocol.unit import load_unit, read_definition

UNIT = '[unit]\nname = "u"\nversion = "1"\ndoc = "d"\n'


@pytest.mark.parametrize(
    "text",
    [
        '[link.serial]\nframing = { kind = "\\nfixed" }\n',
        '[[telecommand]]\nid = 1\nname = "a"\ndoc = "d"\nprovenance = "ours"\nfields = [{ name = "co\\nunt", type = "u8" }]\n',
        '[[enum]]\nname = "a\\u2028b"\ndoc = "d"\nvalues = { low = 1 }\n',
        '"k\\ney" = 1\n',
    ],
    ids=["kind", "name of a field", "name of a table", "key"],
)
def test_an_error_that_quotes_the_definition_is_one_line(tmp_path, text):
    path = tmp_path / "unit.toml"
    path.write_text(text + UNIT if text.startswith('"') else UNIT + text)
    _, errors = read_definition(path)
    assert errors
    assert [error.splitlines() for error in errors] == [[error] for error in errors]
    with pytest.raises(IcdError) as caught:
        load_unit(path)
    assert len(str(caught.value).splitlines()) == 1
