"""The folder of a recording: what is copied into it, and read from it."""

from __future__ import annotations

import contextlib
import importlib.metadata
import json
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, TypeVar

from pydantic import BaseModel, ValidationError

from starhil.emulator.control.scenario import load_scenario
from starhil.emulator.device.state_store import CANOPEN_FILE, STATE_FILE
from starhil.emulator.errors import EmulatorError, explained
from starhil.emulator.launch.machine import description
from starhil.emulator.profile import Profile
from starhil.emulator.profile.profile import PATHS
from starhil.emulator.run.recorder import (
    RUN_FILE,
    SCENARIO_FILE,
    STATE_FOLDER,
)
from starhil.protocol.files.user_file import read_user_file, read_user_text
from starhil.protocol.files.validation import problems

Model = TypeVar("Model", bound=BaseModel)


_COPIED_KEYS: Final = [(key.split("."), mark.recorded_as) for key, mark in PATHS.items() if mark.recorded_as]
"""Keys of files that a recording has a copy of, and the name of the copy."""


class _RunFile(BaseModel):
    """The part of `run.json` that a replay uses."""

    folder: str
    profile: Profile
    machine: dict[str, str]
    """Processor and versions of libraries, see `machine.description`."""


def prepare_recording(folder: Path, profile: Profile, scenario: str) -> None:
    """Make the folder of a recording, with copies of all inputs of the run that may change later."""
    failed, remedy = f"--record {folder}: cannot be used", "choose another folder"
    with explained(failed, remedy):
        folder.mkdir(parents=True, exist_ok=True)
        if any(folder.iterdir()):
            raise EmulatorError(f"--record {folder}: not empty; {remedy}")
    try:
        with explained(failed, remedy):
            _copy_inputs(folder, profile, scenario)
    except EmulatorError:
        shutil.rmtree(folder, ignore_errors=True)  # everything in it is from here
        raise


def _copy_inputs(folder: Path, profile: Profile, scenario: str) -> None:
    values = profile.model_dump(mode="json")
    # what the profile does not set is the unit's, which may have no dialects and another bit rate
    values["links"]["serial"] = profile.links.serial.model_dump(mode="json", exclude_unset=True)
    for keys, name in _COPIED_KEYS:
        table, key = _table_of(values, keys)
        if key in table:
            shutil.copyfile(profile.folder / table[key], folder / name)
            table[key] = name
    state = profile.folder / profile.run.state_dir if profile.run.state_dir else None
    if state is not None:
        values["run"]["state_dir"] = STATE_FOLDER
    if state is not None:
        copy_state(state, folder / STATE_FOLDER)
    if scenario:
        text = load_scenario(scenario).model_dump_json()
        (folder / SCENARIO_FILE).write_text(text, encoding="utf-8")
    run = {
        "starhil": importlib.metadata.version("starhil"),
        "machine": description(),
        "folder": str(profile.folder.resolve()),
        "profile": values,
    }
    (folder / RUN_FILE).write_text(json.dumps(run, indent=1) + "\n", encoding="utf-8")


def copy_state(source: Path, target: Path) -> None:
    """Copy the files of a state folder that a device reads, if there are any; others are nobody's business, or a trap."""
    for name in (STATE_FILE, CANOPEN_FILE):
        with contextlib.suppress(FileNotFoundError):
            content = read_user_file(source / name)
            target.mkdir(exist_ok=True)
            (target / name).write_bytes(content)


def _table_of(values: dict[str, Any], keys: Sequence[str]) -> tuple[dict[str, Any], str]:
    """Return the table that may have a key, empty if there is none, and the last part of the key."""
    *names, last = keys
    for name in names:
        values = values.get(name) or {}
    return values, last


@dataclass(frozen=True)
class RecordedRun:
    """What is known of a recorded run beside its tape."""

    profile: Profile
    machine: Mapping[str, str]


def read_run(folder: Path) -> RecordedRun:
    """Return the profile of a recording, and what else its `run.json` has."""
    path = folder / RUN_FILE
    try:
        text = read_recorded(path)
    except EmulatorError as error:
        raise EmulatorError(f"{error}; give a folder made by starhil run --record") from None
    run = validated(_RunFile, text, path)
    values = run.profile.model_dump(exclude_unset=True)
    for keys, name in _COPIED_KEYS:
        table, key = _table_of(values, keys)
        if table.get(key) == name:
            table[key] = str((folder / name).absolute())
    profile = Profile.model_validate(values)
    return RecordedRun(profile.read_from(Path(run.folder) / RUN_FILE), run.machine)


def read_recorded(path: Path) -> str:
    """Read a file of a recording; an error names it."""
    with explained(f"replay {path}: cannot be read", errors=(OSError, UnicodeDecodeError)):
        text = read_user_text(path)
    return text  # noqa: RET504 (mypy expects that the block may be left without a result)


def validated(model: type[Model], text: str | bytes, where: object) -> Model:
    """Validate JSON of a recording; an error says where it is."""
    try:
        return model.model_validate_json(text)
    except ValidationError as error:
        raise EmulatorError(*(f"replay {where}: {problem}" for problem in problems(error, model))) from None
