"""The device model: the parameters, quantities and actions of the emulated star sensor, for any interface.

They are declared in `configs/units/model.toml`; units bind the fields of their rows to them by name. The
functions that compute quantities and perform actions are in the emulator.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from typing import Annotated, Final, Literal, TypeVar

from pydantic import Field, ValidationError

from starhil.protocol.errors import IcdError, did_you_mean
from starhil.protocol.files.bundled import UNITS_FOLDER
from starhil.protocol.files.user_file import read_user_text
from starhil.protocol.icd.values import (
    DefinitionModel,
    DeviceParameter,
    EnumDefinition,
    Name,
    Parameter,
    Scalar,
)


class QuantityModel(DefinitionModel):
    """A quantity of the device model."""

    name: str
    """Dotted; `[n]` stands for a number from 1 to `count`."""
    type: Literal["bool", "int", "float", "text", "bytes"]
    enum: str | None = None
    unit: str = ""
    count: Annotated[int, Field(ge=1)] | None = None
    doc: str


class ArgumentModel(QuantityModel):
    """An argument of an action."""

    default: Scalar | None = None
    required: bool = False


class ActionModel(DefinitionModel):
    """An action of the device model."""

    name: Name
    doc: str
    arguments: list[ArgumentModel] = []


class ModelEnum(EnumDefinition):
    """An enumeration of the device model."""

    instead: dict[Name, Name] = {}
    """Value → value that a unit reports in its place if its `map` lacks it, because its documents do not know it."""


class DeviceModelFile(DefinitionModel):
    """`configs/units/model.toml`."""

    enum: list[ModelEnum]
    parameter: list[DeviceParameter]
    quantity: list[QuantityModel]
    action: list[ActionModel]


MODEL_FILE: Final = UNITS_FOLDER / "model.toml"

_Declared = TypeVar("_Declared", QuantityModel, ArgumentModel)
_NUMBER: Final = re.compile(r"\[(\d+)\]")

PARAMETER: Final = "parameter."
"""Quantities with this prefix report a parameter of the device."""
HEALTH: Final = "health."
"""Quantities with this prefix report a number from the profile's table `[health]`."""
HEALTH_DEFAULTS: Final = ("temperature.detector", "power.voltage", "power.current", "power.now")
"""Quantities that stand for a number that is not in `[health]`: the one in whose unit the field is."""


@dataclass(frozen=True)
class DeviceModel:
    """Parameters, quantities, actions and enumerations by name."""

    parameters: Mapping[str, Parameter]
    quantities: Mapping[str, QuantityModel]
    actions: Mapping[str, ActionModel]
    enums: Mapping[str, ModelEnum]

    def quantity(self, name: str) -> QuantityModel | None:
        """Return the declaration of a quantity such as `attitude.w` or `stars[3].x`, or None."""
        if name.startswith(PARAMETER):
            parameter = self.parameters.get(name.removeprefix(PARAMETER))
            return None if parameter is None else _of_parameter(name, parameter)
        if name.startswith(HEALTH):
            return QuantityModel(
                name=name,
                type="float",
                unit="*",
                doc="A number from the profile's table [health]; default: the temperature, voltage, current or power of the model.",
            )
        return _numbered(self.quantities.get(generic(name)), name)

    def near_quantities(self, name: str) -> str:
        return did_you_mean(name, [*self.quantities, *(PARAMETER + known for known in self.parameters)])

    def argument(self, action: ActionModel, name: str) -> ArgumentModel | None:
        """Return the declaration of an argument of an action, or None."""
        return _numbered(next((item for item in action.arguments if item.name == generic(name)), None), name)


def _numbered(found: _Declared | None, name: str) -> _Declared | None:
    """Return a declaration if it has the number in the brackets of a name."""
    highest = 0 if found is None or found.count is None else found.count
    return found if all(1 <= int(number) <= highest for number in _NUMBER.findall(name)) else None


def generic(name: str) -> str:
    """Return a name with its number replaced by `[n]`."""
    return _NUMBER.sub("[n]", name)


def number_in(name: str) -> int | None:
    """Return the number in the brackets of a name, or None."""
    found = _NUMBER.search(name)
    return None if found is None else int(found[1])


def _of_parameter(name: str, parameter: Parameter) -> QuantityModel:
    kinds = {"f32": "float", "f64": "float", "bool": "bool", "enum8": "text"}
    return QuantityModel.model_validate(
        {
            "name": name,
            "type": kinds.get(parameter.type, "int"),
            "enum": None if parameter.enum is None else parameter.enum.name,
            "unit": parameter.unit,
            "doc": parameter.doc,
        }
    )


@cache
def device_model() -> DeviceModel:
    """Read `configs/units/model.toml`, once."""
    try:
        file = DeviceModelFile.model_validate(tomllib.loads(read_user_text(MODEL_FILE)))
    except (OSError, ValueError, ValidationError) as error:
        raise IcdError(f"{MODEL_FILE}: not a device model: {' '.join(str(error).split())}") from None
    enums = {item.name: item for item in file.enum}
    return DeviceModel(
        parameters={
            item.name: Parameter.limited(dict(item), enums[item.enumeration] if item.enumeration else None)
            for item in file.parameter
        },
        quantities={item.name: item for item in file.quantity},
        actions={item.name: item for item in file.action},
        enums=enums,
    )
