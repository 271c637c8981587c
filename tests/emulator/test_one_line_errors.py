"""Each error of a profile is one line, whatever keys it has."""

from pathlib import Path

import pytest

from starhil.emulator.errors import EmulatorError
from starhil.emulator.profile import Profile, load_profile
from starhil.emulator.truth.config import FileConfig


@pytest.mark.parametrize("text", ['"k\\ney" = 1\n', '[truth]\nkind = "fixed"\n"k\\ney" = 1\n'])
def test_a_key_with_a_line_break_is_named_in_one_line(tmp_path, text):
    path = tmp_path / "profile.toml"
    path.write_text(text)
    with pytest.raises(EmulatorError, match=r"k\\ney: unknown key") as caught:
        load_profile(str(path))
    assert len(str(caught.value).splitlines()) == 1


@pytest.mark.parametrize(
    "key", ["run.state_dir", "catalog.path", "images.folder", "links.serial.symlink", "unit"]
)
def test_a_path_in_the_home_folder_of_an_unknown_user_is_named_by_its_key(key):
    with pytest.raises(EmulatorError, match=rf"{key}: ~nobody-here has no home folder"):
        load_profile(overrides=[f"{key}=~nobody-here/x"])


def test_a_path_in_the_home_folder_is_expanded_in_every_table(tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    profile = Profile.model_validate(
        {"truth": {"kind": "file", "path": "~/t.csv"}, "run": {"state_dir": "~/state"}, "unit": "~/unit"}
    )
    assert isinstance(profile.truth, FileConfig)
    paths = (profile.truth.path, profile.run.state_dir, profile.unit_source)
    assert paths == tuple(str(tmp_path / name) for name in ("t.csv", "state", "unit"))
    assert Path(load_profile(overrides=["run.state_dir=~/state"]).run.state_dir) == tmp_path / "state"
