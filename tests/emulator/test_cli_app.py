"""What `starhil` does with errors that no command has put into its own words."""

from __future__ import annotations

from pathlib import Path

import pytest
import typer

from emulator.cli import app


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (FileNotFoundError(2, "No such file or directory", "a/b.txt"), "a/b.txt: No such file or directory"),
        (OSError(28, "No space left on device"), "No space left on device"),
        (PermissionError(13, "Permission denied", "a", None, "b"), "a -> b: Permission denied"),
        (OSError("two\nlines"), "two lines"),
        (TimeoutError(), "TimeoutError"),
    ],
)
def test_what_the_system_refuses_is_one_line_and_status_2(
    error: OSError, said: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    built = typer.Typer()

    @built.command()
    def fail() -> None:
        raise error

    monkeypatch.setattr(app, "build_app", lambda: built)
    monkeypatch.setattr("sys.argv", ["starhil"])
    with pytest.raises(SystemExit) as caught:
        app.main()
    printed = capsys.readouterr()
    assert caught.value.code == 2
    assert (printed.out, printed.err) == ("", f"starhil: {said}\n")


def test_a_folder_where_a_file_goes_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("sys.argv", ["starhil", "icd", "export", "markdown", "-o", str(tmp_path)])
    with pytest.raises(SystemExit) as caught:
        app.main()
    printed = capsys.readouterr()
    assert caught.value.code == 2
    assert printed.out == ""
    assert printed.err.startswith("starhil: ")
    assert str(tmp_path) in printed.err
    assert printed.err.count("\n") == 1
