"""Options that a command takes as one dataclass."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import pytest
import typer
from typer.testing import CliRunner

from starhil.emulator.cli.option_groups import with_option_groups

pytestmark = pytest.mark.lowest("typer")


@dataclass(frozen=True)
class Lens:
    """A group of options."""

    fov: Annotated[float, typer.Option(help="Field of view.", min=1.0)] = 42.0
    dark: Annotated[bool, typer.Option("--dark", help="No light.")] = False


@dataclass(frozen=True)
class Files:
    """Another group."""

    record: Annotated[list[Path] | None, typer.Option("-r", "--record")] = None


@with_option_groups
def command(
    name: Annotated[str, typer.Argument()],
    *,
    lens: Lens,
    seed: Annotated[int, typer.Option()] = 1,
    files: Files,
) -> None:
    """Print what arrives."""
    print(name, lens, seed, files)


@pytest.fixture
def call():
    app = typer.Typer()
    app.command()(command)

    def call(*words):
        return CliRunner().invoke(app, words)

    return call


def test_the_fields_of_a_group_are_options_of_the_command(call):
    result = call("x", "--fov", "3", "--dark", "-r", "a", "-r", "b", "--seed", "7")
    assert result.output.strip() == f"x {Lens(3.0, dark=True)} 7 {Files([Path('a'), Path('b')])}"


def test_options_that_are_left_out_have_the_defaults_of_the_fields(call):
    assert call("x").output.strip() == f"x {Lens()} 1 {Files()}"


def test_limits_and_help_are_those_of_the_fields(call):
    assert call("x", "--fov", "0").exit_code == 2
    help_text = call("--help").output
    assert help_text.index("Field of view.") < help_text.index("No light.") < help_text.index("--seed")
