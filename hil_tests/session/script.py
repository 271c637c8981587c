"""Session scripts: TOML files of telecommands, reads and expectations, validated before the run.

`docs/sessions.md` describes the keys. Every step has exactly one of those in `steps.ACTIONS`. All errors of a file are
reported, one a line, with file, step, key and near matches.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Self, TypeVar

from pydantic import ConfigDict, Field, ValidationError, model_validator

from starhil.hil_tests.errors import ScriptError
from starhil.hil_tests.session.expect import Keys, StatedAttitude
from starhil.hil_tests.session.step import Step
from starhil.hil_tests.session.step_keys import FileName, Link, Texts, Timeout
from starhil.hil_tests.session.steps import ACTIONS
from starhil.protocol.errors import MAX_PROBLEMS, did_you_mean
from starhil.protocol.files.user_file import TomlError, read_user_toml
from starhil.protocol.files.validation import problems
from starhil.protocol.icd import InterfaceDefinition

Table = TypeVar("Table", bound=Keys)


class Truth(StatedAttitude):
    """The true attitude, or a file of true attitudes over time that the emulator writes."""

    file: FileName | None = None

    @model_validator(mode="after")
    def _one_form(self) -> Self:
        if self.attitude is not None and self.file is not None:
            raise ValueError("give an attitude or a file, not both")
        return self


class EmulatorRequest(Keys):
    """How `--start` starts the emulator for this script."""

    profile: str | None = None
    settings: Texts = Field([], alias="set")
    seed: Annotated[int, Field(ge=0)] | None = None


class Defaults(Keys):
    """Defaults for all steps."""

    timeout_s: Timeout = 1.0
    retries: Annotated[int, Field(ge=0)] = 0
    keep_going: bool = False
    link: Link | None = None


class Script(Keys):
    """A validated session script."""

    model_config = ConfigDict(populate_by_name=False)

    title: str = ""
    doc: str = ""
    truth: Truth = Truth()
    emulator: EmulatorRequest = EmulatorRequest()
    defaults: Defaults = Defaults()
    steps: tuple[Step, ...] = Field((), alias="step")

    def planned(self, links: tuple[str, ...]) -> list[tuple[int, Step, str]]:
        """Return number, step and link of each step on each of its links; `links` are those of the bench, "" is none."""

        def links_of(step: Step) -> tuple[str, ...]:
            wanted = (step.link or self.defaults.link or links[0]) if step.needs_link else ""
            return links if wanted == "both" else (wanted,)

        return [(number, step, link) for number, step in enumerate(self.steps, 1) for link in links_of(step)]


def load_script(path: Path, icd: InterfaceDefinition) -> Script:
    """Read and check a session script.

    Raises ScriptError: the file cannot be read, is not TOML, or does not match the interface definition;
    one line for each error.
    """
    try:
        document = read_user_toml(path)
    except OSError as error:
        raise ScriptError(f"{path}: cannot be read: {error.strerror}") from None
    except TomlError as error:
        raise ScriptError(f"{path}: not valid TOML: {error}") from None
    if "step" not in document:
        hint = did_you_mean("step", document) or f"; its keys are {', '.join(document) or 'none'}"
        raise ScriptError(f"{path.name}: not a session script: has no steps, each under [[step]]{hint}")
    tables = document.pop("step")
    if not isinstance(tables, list) or not tables or not all(isinstance(table, dict) for table in tables):
        raise ScriptError(f"{path.name}: 'step' must be an array of tables: write [[step]] before each")
    script, wrong = _checked(Script, {"title": path.stem.replace("_", " "), **document}, path.name)
    captured: set[str] = set()
    context = {"icd": icd, "captured": captured, "has_truth": bool(document.get("truth"))}
    steps: list[Step | None] = []
    for number, table in enumerate(tables, 1):
        step, found = _step(f"{path.name}: step {number}", table, context)
        steps.append(step)
        wrong += found
        names = table.get("capture")
        captured.update(names if isinstance(names, dict) else ())  # also of a step with an error
        if len(wrong) >= MAX_PROBLEMS and number < len(tables):
            rest = f"{path.name}: {len(tables) - number} more steps are not checked; correct these first"
            wrong.insert(MAX_PROBLEMS - 1, rest)
            break
    if wrong or script is None:
        raise ScriptError(*wrong)
    return script.model_copy(update={"steps": tuple(steps)})


def _step(where: str, table: dict[str, Any], context: dict[str, Any]) -> tuple[Step | None, list[str]]:
    present = [key for key in ACTIONS if key in table]
    if len(present) == 1:
        return _checked(ACTIONS[present[0]], table, where, context)
    known = {field.alias or name for cls in ACTIONS.values() for name, field in cls.model_fields.items()}
    unknown = [key for key in table if key not in known]
    hint = f"; '{unknown[0]}' is unknown{did_you_mean(unknown[0], known)}" if unknown else ""
    found = f"has {' and '.join(present)}" if present else "has none"
    return None, [f"{where}: needs exactly one action of {', '.join(ACTIONS)}; {found}{hint}"]


def _checked(
    model: type[Table], table: dict[str, Any], where: str, context: dict[str, Any] | None = None
) -> tuple[Table | None, list[str]]:
    """Validate a table; return the result, or the problems: of its keys, and of the whole without the wrong ones.

    The context `broken` has the keys that were left out.
    """
    try:
        return model.model_validate(table, context={**(context or {}), "broken": frozenset()}), []
    except ValidationError as error:
        found_problems = list(problems(error, model))
    broken = {problem.location[0] for problem in found_problems if problem.location}
    if broken:
        rest = {key: value for key, value in table.items() if key not in broken}
        try:
            model.model_validate(rest, context={**(context or {}), "broken": broken})
        except ValidationError as error:
            found_problems += [problem for problem in problems(error, model) if not problem.location]
    texts = (str(problem) if problem.key else problem.text for problem in found_problems)
    return None, list(dict.fromkeys(f"{where}: {text}" for text in texts))
