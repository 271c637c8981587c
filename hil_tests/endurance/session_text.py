"""A shortened life as a session script, for a run by hand."""

from __future__ import annotations

import json

from starhil.hil_tests.endurance.life import Life
from starhil.hil_tests.raw_traffic import format_frame
from starhil.protocol.can_framing import encode_request_frames
from starhil.protocol.definition import InterfaceDefinition
from starhil.protocol.messages import Request, RequestKind
from starhil.protocol.serial_stack import build_serial_stack

LONGEST_WAIT_S = 3600.0


def session_of(life: Life, icd: InterfaceDefinition, violation: str) -> str:
    """Return a session script with the requests of a life on serial and CAN, and its waits.

    What a session cannot do (faults, truth, power, CANopen) stands in a comment where it was done.
    """
    lines = [
        f"title = {json.dumps(f'{life.unit}, seed {life.seed}')}",
        f"doc = {json.dumps(violation)}",
        "",
        "[emulator]",
        f"set = {json.dumps([f'unit={life.unit}', *_settings(life)])}",
        f"seed = {life.seed}",
    ]
    for number, step in enumerate(life.steps, 1):
        name = f"name = {json.dumps(f'step {number}')}"
        match step["do"]:
            case "wait":
                lines += ["", "[[step]]", name, f"wait_s = {min(step['s'], LONGEST_WAIT_S)}"]
            case "request" if step["link"] != "canopen":
                klass, row_id, kind = step["row"]
                data = bytes.fromhex(step.get("data", ""))
                request = Request(RequestKind(kind), row_id, data, klass=klass)
                if step["link"] == "serial":
                    sent = [build_serial_stack(icd).encode_request(request).hex(" ")]
                else:
                    sent = [format_frame(frame) for frame in encode_request_frames(request, 1, 4)]
                lines += ["", "[[step]]", name, f'link = "{step["link"]}"', f"send = {json.dumps(sent)}"]
            case _:
                lines += ["", f"# step {number}, not possible in a session: {json.dumps(step)}"]
    return "\n".join(lines) + "\n"


def _settings(life: Life) -> list[str]:
    return [
        f"{section}.{key}={value}"
        for section, values in life.profile.items()
        for key, value in values.items()
    ]
