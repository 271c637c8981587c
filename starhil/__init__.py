"""A star-sensor emulator for hardware-in-the-loop tests; the names here are its public interface in Python.

A name loads its module when it is first used, so importing `starhil` costs nothing.

In the repository, the subpackages are symbolic links to top-level folders; an installed package contains the
folders.
"""

from __future__ import annotations

import importlib
import os.path
from typing import TYPE_CHECKING, Final

if os.path.isfile(os.path.join(os.path.dirname(__file__), "emulator")):  # noqa: PTH113, PTH118, PTH120 -- pathlib loads slowly
    raise ImportError(
        "starhil: this checkout was unpacked without its symbolic links (starhil/emulator is a file); clone it with git, "
        "on Windows in WSL, or unpack it with tar"
    )

if TYPE_CHECKING:
    from starhil.emulator.errors import EmulatorError as EmulatorError
    from starhil.emulator.launch.emulator import Emulator as Emulator
    from starhil.emulator.launch.emulator import RunOptions as RunOptions
    from starhil.emulator.profile import Profile as Profile
    from starhil.emulator.profile import load_profile as load_profile
    from starhil.hil_tests.client import AsyncObcClient as AsyncObcClient
    from starhil.hil_tests.client import ObcClient as ObcClient
    from starhil.hil_tests.client.transactions import Ack as Ack
    from starhil.hil_tests.client.transactions import Reading as Reading
    from starhil.hil_tests.errors import BadReplyError as BadReplyError
    from starhil.hil_tests.errors import BenchError as BenchError
    from starhil.hil_tests.errors import LinkLostError as LinkLostError
    from starhil.hil_tests.errors import NackError as NackError
    from starhil.hil_tests.errors import NoReplyError as NoReplyError
    from starhil.hil_tests.rig.emulator_process import EmulatorProcess as EmulatorProcess
    from starhil.protocol.icd import InterfaceDefinition as InterfaceDefinition
    from starhil.protocol.icd.definition import UnknownNameError as UnknownNameError
    from starhil.protocol.icd.values import FieldError as FieldError
    from starhil.protocol.unit import load_unit as load_unit

    __version__: str

_PUBLIC: Final = {
    "starhil.emulator.errors": ("EmulatorError",),
    "starhil.emulator.launch.emulator": ("Emulator", "RunOptions"),
    "starhil.emulator.profile": ("Profile", "load_profile"),
    "starhil.hil_tests.client": ("AsyncObcClient", "ObcClient"),
    "starhil.hil_tests.client.transactions": ("Ack", "Reading"),
    "starhil.hil_tests.errors": ("BadReplyError", "BenchError", "LinkLostError", "NackError", "NoReplyError"),
    "starhil.hil_tests.rig.emulator_process": ("EmulatorProcess",),
    "starhil.protocol.icd": ("InterfaceDefinition",),
    "starhil.protocol.icd.definition": ("UnknownNameError",),
    "starhil.protocol.icd.values": ("FieldError",),
    "starhil.protocol.unit": ("load_unit",),
}
_MODULES: Final = {name: module for module, names in _PUBLIC.items() for name in names}

__all__ = ["__version__", *_MODULES]  # noqa: PLE0604 - the keys are names


def __getattr__(name: str) -> object:
    if name == "__version__":
        from importlib.metadata import version

        return version("starhil")
    if name not in _MODULES:
        raise AttributeError(f"module 'starhil' has no attribute {name!r}")
    value = getattr(importlib.import_module(_MODULES[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(__all__)
