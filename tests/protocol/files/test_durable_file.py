"""Files that are replaced as a whole: interrupted calls and links in the place of the temporary file do no harm."""

import pytest

from starhil.protocol.files.durable_file import replace_durably


@pytest.mark.parametrize("left", ["file", "link", "dangling link"])
def test_what_is_in_the_place_of_the_temporary_file_is_replaced_and_not_followed(tmp_path, left):
    state, temporary, other = (tmp_path / name for name in ("state", "state.new", "other"))
    if left != "dangling link":
        other.write_bytes(b"precious")
    if left == "file":
        temporary.write_bytes(b"a longer beginning")
    else:
        temporary.symlink_to(other)
    replace_durably(state, b"new")
    assert state.read_bytes() == b"new"
    assert not state.is_symlink()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["other", "state"][left == "dangling link" :]
    assert left == "dangling link" or other.read_bytes() == b"precious"
