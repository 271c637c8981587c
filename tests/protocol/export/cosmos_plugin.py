"""The exported COSMOS plugin as COSMOS would install it: variables filled in, its protocol loaded."""

from __future__ import annotations

import re
import sys
import types
from pathlib import Path
from typing import Any

from starhil.protocol.export import export_folder
from starhil.protocol.icd import InterfaceDefinition


class ProtocolWithoutCosmos:
    """What the protocol needs of the base class that COSMOS has."""

    def __init__(self, _allow_empty_data: object = None) -> None:
        self.reset()

    def reset(self) -> None:
        pass


class Plugin:
    """The installed files.

    Attributes
    ----------
    target
        Name of the target.
    lines
        Lines of plugin.txt as words.
    """

    def __init__(self, icd: InterfaceDefinition, folder: Path, **variables: object) -> None:
        files = dict(export_folder(icd, "cosmos-plugin"))
        declared = dict(re.findall(r"^VARIABLE (\w+) (\S+)$", files["plugin.txt"], re.MULTILINE))
        assert variables.keys() <= declared.keys()
        declared |= {name: str(value) for name, value in variables.items()}
        for path, text in files.items():
            for name, value in declared.items():
                text = text.replace(f"<%= {name} %>", value)
            assert "<%" not in text
            (folder / path).parent.mkdir(parents=True, exist_ok=True)
            (folder / path).write_text(text)
        self.target = declared["target_name"]
        self.lines = [line.split() for line in (folder / "plugin.txt").read_text().splitlines() if line]
        source = next(words[1] for words in self.lines if words[0] == "TARGET")
        self._folder = folder / "targets" / source

    def text(self, path: str) -> Path:
        """Return a file of the target."""
        return self._folder / path

    def arguments(self, keyword: str) -> list[str]:
        """Return the words after a keyword of plugin.txt."""
        return next(words[1:] for words in self.lines if words[0] == keyword)

    def protocol(self) -> Any:
        """Return the protocol that plugin.txt asks for; without COSMOS on a stand-in for its base class."""
        direction, file, *arguments = self.arguments("PROTOCOL")
        assert direction == "READ_WRITE"
        return self.protocol_class(file)(*arguments)

    def protocol_class(self, file: str) -> Any:
        name = "openc3.interfaces.protocols.protocol"
        if "openc3" not in sys.modules:
            try:
                __import__(name)
            except ImportError:
                stub = types.ModuleType(name)
                vars(stub)["Protocol"] = ProtocolWithoutCosmos
                sys.modules[name] = stub
        path = self.text(f"lib/{file}")
        namespace: dict[str, Any] = {}
        exec(compile(path.read_text(), str(path), "exec"), namespace)
        return namespace["".join(word.capitalize() for word in path.stem.split("_"))]
