"""Custom functions of a unit, in a Python file beside its definition.

Example of `unit.py` beside the TOML files of a unit with `plugin = "unit.py"` in `[unit]`::

    from starhil.protocol.plugin import action, check, framing, quantity

    @quantity("battery.voltage", unit="V")
    def battery_voltage(snapshot):
        return 3.7

    @action("blink")
    def blink(device, arguments):
        device.reset("command")

The function of a quantity is called with a `starhil.emulator.device.snapshot.Snapshot` of the device. The
function of an action is called with the device and the arguments by name; it returns nothing, messages that
follow the answer, or `bytes`, which are the data of the answer; a list of `bytes` makes several answers.
Framings and checks are used by `starhil.protocol.composed_stack`.
"""

from __future__ import annotations

import runpy
from collections.abc import Callable, Mapping
from contextvars import ContextVar
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

from starhil.protocol.values import IcdError

Function = TypeVar("Function")


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
    return _registering("framings", name)


def check(name: str) -> Callable[[Function], Function]:
    """Register a function of bytes as a check."""
    return _registering("checks", name)


def load_plugin(file: Path) -> Plugin:
    """Run the plugin of a unit and return the functions that it defines.

    Raises IcdError with the error of the plugin in one line.
    """
    plugin = Plugin()
    token = _loading.set(plugin)
    try:
        runpy.run_path(str(file))
    except FileNotFoundError:
        raise IcdError(f"{file}: no such plugin; unit.plugin names a file beside the definition") from None
    except Exception as error:
        text = " ".join(str(error).split())
        raise IcdError(f"{file}: the plugin fails: {type(error).__name__}: {text}") from error
    finally:
        _loading.reset(token)
    return plugin
