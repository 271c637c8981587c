"""Checks of the bindings of a unit's fields to quantities, arguments of actions and parameters."""

from __future__ import annotations

from collections.abc import Iterator

from starhil.protocol.errors import IcdError, did_you_mean, remedy
from starhil.protocol.icd import InterfaceDefinition
from starhil.protocol.icd.codec import Field, Row
from starhil.protocol.icd.device_model import ActionModel, ArgumentModel, DeviceModel, QuantityModel, generic
from starhil.protocol.units_of_measure import convertible, factor

ANY_UNIT = "*"
SET_PARAMETERS = "set_parameters"
"""The action whose fields are bound to parameters instead of arguments."""


def check_row(row: Row, icd: InterfaceDefinition, *, complete: bool = True) -> Iterator[str]:
    """Yield the errors in the bindings of the fields of a row; `complete`: it has all its fields.

    A text names the field and, for an unknown name, similar ones.
    """
    model, plugin = icd.model, icd.plugin
    custom = row.action in plugin.actions  # checks its arguments itself
    action = None if row.action is None or custom else model.actions.get(row.action)
    if action is None and row.action is not None and not custom and plugin.skipped is None:
        known = [*model.actions, *plugin.actions]
        yield f"no action named {row.action!r}{did_you_mean(row.action, known)}"
    for field in row.named_fields.values():
        try:
            _check_field(field, row, action, icd)
        except IcdError as error:
            yield f"field {field.name}: {error}"
    if action is not None and complete:
        yield from _missing(row, action)


def _check_field(field: Field, row: Row, action: ActionModel | None, icd: InterfaceDefinition) -> None:
    sources = [
        name for name in ("value", "argument", "const", "parameter") if getattr(field, name) is not None
    ]
    if len(sources) > 1 and sources != ["argument", "parameter"]:
        raise IcdError(f"has {' and '.join(sources)}; keep one of them")
    if field.value is not None:
        _check_value(field, row, icd)
    if field.argument is not None:
        _check_argument(field, row, action, icd.model)
    if (
        action is not None
        and action.name == SET_PARAMETERS
        and (field.parameter, field.const) == (None, None)
    ):
        raise IcdError("sets nothing; bind it to a parameter with `parameter`, or leave out its name")


def unbound(icd: InterfaceDefinition) -> list[str]:
    """Return an error message for each row or field that the device cannot serve, because nothing gives it a value or sends it."""
    missing = [
        f"{icd.files[row.name]}: telecommand {row.name}: no `action`; use `nothing` to accept the telecommand without effect"
        for row in icd.telecommands.values()
        if row.action is None
    ]
    missing += [
        f"{icd.files[row.name]}: telemetry {row.name}: field {field.name}: no `value`, `const`, `parameter` or `default`; "
        "a field without a name is sent as zeros"
        for row in icd.telemetry.values()
        if not row.zeros
        for field in row.named_fields.values()
        if (field.value, field.const, field.parameter, field.default, field.telecommand) == (None,) * 5
    ]
    if not icd.selects_unsolicited:
        answers = {answer for row in icd.rows for answer in row.answers}
        missing += [
            f"{icd.files[row.name]}: telemetry {row.name}: `request = false`, but nothing sends it; add `unsolicited`, "
            f"or 'row:{row.name}' to the `answer` of another row"
            for row in icd.telemetry.values()
            if row.only_sent and row.unsolicited is None and f"row:{row.name}" not in answers
        ]
    return missing


def quantity_of(name: str, icd: InterfaceDefinition) -> QuantityModel | None:
    """Return the declaration of a quantity of the device model or of the unit's plugin, or None."""
    custom = icd.plugin.quantities.get(name)
    if custom is not None:
        return QuantityModel(name=name, type="float", unit=custom.unit or ANY_UNIT, doc=custom.doc)
    return icd.model.quantity(name)


def _check_value(field: Field, row: Row, icd: InterfaceDefinition) -> None:
    name = str(field.value)
    if row.kind != "telemetry":
        raise IcdError("`value` is for telemetry; a field of a telecommand has an `argument`")
    quantity = quantity_of(name, icd)
    if quantity is None and icd.plugin.skipped is not None:
        return
    if quantity is None:
        raise IcdError(f"no quantity named {name!r}{icd.model.near_quantities(name)}")
    if name not in icd.plugin.quantities:
        _check_fit(field, quantity, f"quantity {name}", icd.model)
        _check_members(field, quantity, icd.model)


def _check_argument(field: Field, row: Row, action: ActionModel | None, model: DeviceModel) -> None:
    name = str(field.argument)
    if row.kind != "telecommand":
        raise IcdError("`argument` is for telecommands; a telemetry field has a `value`")
    if row.action is None:
        raise IcdError(f"argument {name}: the row has no `action`")
    if action is None:
        return  # unknown, or an action of the plugin
    argument = model.argument(action, name)
    if argument is None:
        arguments = [item.name for item in action.arguments]
        raise IcdError(
            f"action {action.name} has no argument {name!r}{did_you_mean(name, arguments)} "
            f"(known: {', '.join(arguments) or 'none'})"
        )
    _check_fit(field, argument, f"argument {name}", model)
    if argument.enum is not None and field.enum is not None:
        names = [*field.enum.values, *field.aliases]
        wrong = [item for item in names if item not in model.enums[argument.enum].values]
        if wrong:
            hint = remedy(wrong[0], model.enums[argument.enum].values)
            raise IcdError(f"{wrong[0]!r} is not a value of argument {name}{hint}")


def _check_fit(field: Field, source: QuantityModel | ArgumentModel, what: str, model: DeviceModel) -> None:
    """Check that a field can hold the values of a quantity or argument, and that the units are compatible."""
    if source.unit != ANY_UNIT and factor(source.unit, field.unit) is None:
        units = ", ".join(repr(unit) for unit in convertible(source.unit))
        raise IcdError(f"unit {field.unit!r}, but {what} is in {source.unit!r}; use one of {units}")
    names = source.enum is not None or source.type == "text"
    fits = {
        "bytes": field.kind == "bytes",
        "text": field.kind in ("enum", "text"),
        "bool": field.kind in ("flag", "integer", "bits", "enum"),
    }.get(source.type, field.kind in ("integer", "float", "bits", "enum", "flag"))
    if names and field.kind not in ("enum", "text"):
        members = "" if source.enum is None else f": {', '.join(model.enums[source.enum].values)}"
        raise IcdError(f"{what} has named values{members}; assign numbers with `enum` or `map`")
    if not fits:
        raise IcdError(f"{what} is of type {source.type}, which a field of kind {field.kind} cannot hold")


def _check_members(field: Field, quantity: QuantityModel, model: DeviceModel) -> None:
    """Check that an enumeration has a number for every value of the quantity."""
    if field.enum is None or field.default is not None:
        return
    members = ["true", "false"] if quantity.type == "bool" else []
    if quantity.enum is not None:
        members = list(model.enums[quantity.enum].values)
    missing = [name for name in members if name not in field.enum.values and name not in field.aliases]
    if missing:
        names = ", ".join(missing)
        raise IcdError(f"quantity {field.value} has no number for {names}; add one, or a `default`")


def _missing(row: Row, action: ActionModel) -> Iterator[str]:
    given = {generic(str(field.argument)) for field in row.named_fields.values()} | set(row.arguments)
    missing = [item.name for item in action.arguments if item.required and item.name not in given]
    for name in missing:
        yield f"action {action.name} needs the argument {name}; bind a field to it with `argument`"
    known = {item.name for item in action.arguments}
    for name in row.arguments:
        if name not in known:
            yield f"action {action.name} has no argument {name!r}{did_you_mean(name, known)}"
