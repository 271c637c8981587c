"""The interface definition as a plugin of OpenC3 COSMOS: target, commands and telemetry, and the protocol of the serial line.

The protocol is self-contained Python, put together from the files of this folder, since COSMOS does not have
this package. It gives COSMOS packets of the form that the format `cosmos` describes, each command of
telemetry included, and the packet ANSWER for what answers a command.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Final

from starhil.protocol.composed_stack import ComposedStack
from starhil.protocol.export import cosmos
from starhil.protocol.export.cosmos_plugin.composed import link_text
from starhil.protocol.export.row_key import key_bits, key_of
from starhil.protocol.icd import InterfaceDefinition
from starhil.protocol.messages import BURST_ID
from starhil.protocol.serial_interface import SerialStack
from starhil.protocol.serial_stack import build_serial_stack

TARGET: Final = "<%= target_name %>"
"""Name of the target, which COSMOS fills in when the plugin is installed."""


def render_folder(icd: InterfaceDefinition) -> Mapping[str, str]:
    """Return the files of the plugin by path.

    Raises IcdError for a unit without a serial link, and for one whose link is code of a plugin.
    """
    stack = build_serial_stack(icd)
    name = re.sub(r"\W", "_", icd.name.lower())
    head = f"# {icd.name} {icd.version}: {icd.doc}\n# Made by starhil from the interface definition; do not edit.\n"
    composed = isinstance(stack, ComposedStack)
    target = {
        "target.txt": f"LANGUAGE python\nIGNORE_PARAMETER {cosmos.IDENTIFIER}\nIGNORE_ITEM {cosmos.IDENTIFIER}\n",
        "cmd_tlm/cmd.txt": "\n".join(cosmos.commands(icd, TARGET)) + "\n",
        "cmd_tlm/tlm.txt": "\n".join(_telemetry(icd, with_bursts=not composed)) + "\n",
        f"lib/{name}_protocol.py": _protocol(icd, stack, name),
    }
    declared, argument = ("", "") if composed else ("VARIABLE dialect b\n", " <%= dialect %>")
    plugin = _PLUGIN.format(
        name=name, target=name.upper(), baud=stack.baud, declared=declared, argument=argument
    )
    return {
        "plugin.txt": head + plugin,
        f"openc3-cosmos-{name}.gemspec": _GEMSPEC.format(name=name, doc=icd.doc.replace("'", "")),
        "Rakefile": _RAKEFILE,
        "README.md": _README.format(unit=icd.name),
    } | {f"targets/{name.upper()}/{path}": head + text for path, text in target.items()}


def _telemetry(icd: InterfaceDefinition, *, with_bursts: bool) -> Iterator[str]:
    bits = key_bits(icd)
    yield from cosmos.telemetry(icd, TARGET)
    yield ""
    yield f'TELEMETRY {TARGET} ANSWER BIG_ENDIAN "Answer to a command: accepted (0) or the code of its refusal."'
    yield f'  APPEND_ID_ITEM {cosmos.IDENTIFIER} {bits} UINT {answer_id(icd)} "Identifier"'
    yield f'  APPEND_ITEM COMMAND {bits} UINT "Command that is answered."'
    for row in icd.rows:
        command = row.name if row.kind == "telecommand" else f"request_{row.name}"
        yield f"    STATE {command.upper()} {key_of(icd, row)}"
    yield '  APPEND_ITEM CODE 8 UINT "0, or the code of the refusal."'
    codes = icd.enums.get("error_code")
    if codes is not None:
        yield from (f"    STATE {label.upper()} {value}" for label, value in codes.values.items())
    if with_bursts:
        yield f'\nTELEMETRY {TARGET} FILE_BURST BIG_ENDIAN "Packet of a file block: number and data."'
        yield f'  APPEND_ID_ITEM {cosmos.IDENTIFIER} {bits} UINT {BURST_ID} "Identifier"'
        yield '  APPEND_ITEM NUMBER 16 UINT "Number of the packet in its block." LITTLE_ENDIAN'
        yield '  APPEND_ITEM DATA 160 BLOCK "20 bytes of the file."'


def answer_id(icd: InterfaceDefinition) -> int:
    """Return the identifier of the packet ANSWER: the first that no row has."""
    used = {key_of(icd, row) for row in icd.rows}
    return next(number for number in range(2 ** key_bits(icd)) if number not in used)


def _protocol(icd: InterfaceDefinition, stack: SerialStack, name: str) -> str:
    imports, _, protocol = _part("protocol.py.in").partition("class ")
    constants = f"ID_BYTES = {key_bits(icd) // 8}\nANSWER = {answer_id(icd)}\n"
    if isinstance(stack, ComposedStack):
        link = link_text(stack)
    else:
        sizes = ", ".join(f"{row.id}: {row.size}" for row in icd.telemetry.values())
        link = (
            f"# Bytes of data of each telemetry row\nSIZES = {{{sizes}}}\n\n\n{_part('cubespace_link.py.in')}"
        )
    return f"{imports}{constants}{link}\n\nclass " + protocol.replace("@CLASS@", _class_name(name))


def _class_name(name: str) -> str:
    """Return the name of the class that COSMOS looks for in a file."""
    return "".join(word.capitalize() for word in f"{name}_protocol".split("_"))


def _part(name: str) -> str:
    return (Path(__file__).parent / name).read_text(encoding="utf-8")


_PLUGIN: Final = """
VARIABLE target_name {target}
VARIABLE port /dev/ttyUSB0
VARIABLE baud {baud}
{declared}VARIABLE reply_timeout 1.0

TARGET {target} <%= target_name %>
INTERFACE <%= target_name %>_INT openc3/interfaces/serial_interface.py <%= port %> <%= port %> <%= baud %> NONE 1 10.0 nil
  MAP_TARGET <%= target_name %>
  PROTOCOL READ_WRITE {name}_protocol.py <%= reply_timeout %>{argument}
"""

_GEMSPEC: Final = """\
Gem::Specification.new do |s|
  s.name = 'openc3-cosmos-{name}'
  s.summary = '{name} on a serial line'
  s.description = '{doc}'
  s.authors = ['starhil']
  s.platform = Gem::Platform::RUBY
  s.required_ruby_version = '>= 3.0'
  s.version = ENV['VERSION'] || '0.0.0'
  s.files = Dir.glob('targets/**/*') + %w(Rakefile README.md plugin.txt)
end
"""

_RAKEFILE: Final = """\
task :build do
  abort 'rake build VERSION=X.Y.Z' unless ENV['VERSION']
  sh 'gem', 'build', Dir['*.gemspec'].first
end
"""

_README: Final = """\
# {unit} as a plugin of OpenC3 COSMOS

Made by starhil from the interface definition of the unit. `rake build VERSION=1.0.0` makes the gem to install in COSMOS; it asks for
the serial port, its bit rate and, of some units, the dialect of their replies. A container sees no serial port of its host: hand it in as a device,
or bring it to a TCP port and replace `serial_interface.py` by `tcpip_client_interface.py` in `plugin.txt`.

Each telecommand is a command; `REQUEST_…` asks for telemetry. `ANSWER` is what comes back for a command: its name and the code.
The protocol sends one request at a time, since a reply may not name its row.
"""
