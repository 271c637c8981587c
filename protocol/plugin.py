"""Custom functions of a unit, in a Python file beside its definition.

Example of `unit.py` beside the TOML files of a unit with `plugin = "unit.py"` in `[unit]`::

    from starhil.protocol.plugin import action, check, framing, quantity

    @quantity("battery.voltage", unit="V")
    def battery_voltage(snapshot):
        return 3.6 if snapshot.mode.makes_frames else 3.7

    @action("blink")
    def blink(device, arguments):
        device.reset("command")

The function of a quantity gets a `starhil.emulator.device.snapshot.Snapshot`: the device at one moment, from which the
whole row is packed. It has access to neither the device nor a clock. `emulator/device/snapshot.py` has the fields of a snapshot.
The function of an action gets the device, and the arguments by name. It returns nothing, messages that follow the answer,
or `bytes`, the data of the answer; a list of `bytes` makes several answers.
A framing is a class derived from `starhil.protocol.serial.framings.Framing`, whose constructor takes no arguments; a
check is a function that returns the check of the covered bytes. docs/your-unit.md has an example of each.
"""

from __future__ import annotations

import os
import runpy
from collections.abc import Callable, Mapping
from contextvars import ContextVar
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

from starhil.protocol.errors import IcdError, ProtocolError
from starhil.protocol.files.user_file import read_user_file

Function = TypeVar("Function")
Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")


@dataclass(frozen=True)
class PluginQuantity:
    """A quantity that a plugin computes."""

    function: Callable[[Any], Any]
    unit: str
    doc: str


@dataclass(frozen=True)
class Plugin:
    """Functions defined by the plugin of a unit, by name."""

    quantities: dict[str, PluginQuantity] = field(default_factory=dict)
    actions: dict[str, Callable[[Any, Mapping[str, Any]], Any]] = field(default_factory=dict)
    framings: dict[str, Any] = field(default_factory=dict)
    checks: dict[str, Any] = field(default_factory=dict)
    skipped: str | None = None
    """Name of the plugin's file if it was not run, so that any unknown name may be the plugin's."""


_loading: ContextVar[Plugin | None] = ContextVar("plugin that is being loaded", default=None)


def quantity(name: str, *, unit: str = "", doc: str = "") -> Callable[[Function], Function]:
    """Register a function of a snapshot as a quantity, to which rows can be bound with `value`."""
    return _registering("quantities", name, lambda function: PluginQuantity(function, unit, doc))


def _registering(
    table: str, name: str, entry: Callable[[Any], Any] = lambda function: function
) -> Callable[[Function], Function]:
    """Return a decorator that registers a function, or the result of `entry`, in the plugin being loaded."""

    def register(function: Function) -> Function:
        plugin = _loading.get()
        if plugin is None:
            raise IcdError("functions of a plugin can be registered only while its unit is being loaded")
        getattr(plugin, table)[name] = entry(function)
        return function

    return register


def action(name: str) -> Callable[[Function], Function]:
    """Register a function of device and arguments as an action."""
    return _registering("actions", name)


def framing(name: str) -> Callable[[Function], Function]:
    """Register a class as a framing."""
    return _registering("framings", name, partial(guarded, f"framing {name}"))


def check(name: str) -> Callable[[Function], Function]:
    """Register a function of bytes as a check."""
    return _registering("checks", name, partial(guarded, f"check {name}"))


def guarded(what: str, function: Callable[Arguments, Result]) -> Callable[Arguments, Result]:
    """Return a function of a plugin whose failures, an exit included, are raised as an IcdError of one line."""

    def call(*arguments: Arguments.args, **named: Arguments.kwargs) -> Result:
        try:
            return function(*arguments, **named)
        except (ProtocolError, KeyboardInterrupt):
            raise
        except BaseException as error:
            text = " ".join(f"{type(error).__name__}: {error}".split()).removesuffix(":")
            raise IcdError(f"the plugin fails in {what}: {text}") from error

    return call


def load_plugin(folder: Path, name: str) -> Plugin:
    """Run the plugin of a unit and return the functions that it defines.

    Raises IcdError, with one line, for a name that is not that of a file in the folder, also if this is a link to
    another folder; for a file that cannot be read; and for an error of the plugin.
    """
    file = folder / name
    try:
        beside = file.name == name and Path(os.path.realpath(file)).parent == Path(os.path.realpath(folder))
    except ValueError:  # no file name
        beside = False
    if not beside:
        raise IcdError(f"unit.plugin: {name!r} must be the name of a file beside the definition")
    try:
        read_user_file(file)  # rejects a pipe, on which running it would wait
    except FileNotFoundError:
        raise IcdError(f"unit.plugin: {name!r}: no such plugin; it is a file beside the definition") from None
    except OSError as error:
        raise IcdError(f"unit.plugin: {file}: cannot be read: {error.strerror}") from None
    plugin = Plugin()
    token = _loading.set(plugin)
    try:
        guarded(name, runpy.run_path)(str(file))
    finally:
        _loading.reset(token)
    return plugin
