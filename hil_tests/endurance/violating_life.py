"""A life that ends in a violation: shortened to the fewest steps that still show it, and as a session for a run by hand."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Sequence
from dataclasses import replace

from starhil.hil_tests.endurance.life import Life, Step
from starhil.hil_tests.endurance.ports import HOST
from starhil.hil_tests.judge import can
from starhil.hil_tests.judge.definition import Unit
from starhil.hil_tests.judge.links import LINKS
from starhil.hil_tests.judge.messages import Request
from starhil.hil_tests.judge.serial import SerialLine
from starhil.protocol.can.frame import CanFrame

LONGEST_WAIT_S = 3600.0


def kind_of(violation: str) -> str:
    """Return a violation without its numbers, to tell whether two are of the same kind."""
    return re.sub(r"-?\d[\d.e+-]*", "#", violation)


def shortened(life: Life, fails: Callable[[Life], bool], *, attempts: int = 400) -> Life:
    """Return the life with as few steps as possible for which `fails` holds (delta debugging, Zeller 1999).

    At most this many `attempts` are made to live a shorter life.
    """
    left = attempts

    def still_fails(steps: Sequence[Step]) -> bool:
        nonlocal left
        left -= 1
        return fails(replace(life, steps=tuple(steps)))

    steps = list(life.steps)
    size = max(1, len(steps) // 2)
    while left > 0:
        removed = False
        start = 0
        while start < len(steps) and left > 0:
            rest = steps[:start] + steps[start + size :]
            if still_fails(rest):
                steps, removed = rest, True
            else:
                start += size
        if size == 1 and not removed:
            break
        size = max(1, size // 2)
    return replace(life, steps=tuple(steps))


def session_of(life: Life, definition: Unit, violation: str) -> str:
    """Return a session script with the requests of a life on serial and CAN, and its waits.

    What a session cannot do (faults, truth, power, CANopen) is a comment at its place.
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
                message_class, row_id, kind = step["row"]
                request = Request(
                    row_id, bytes.fromhex(step.get("data", "")), message_class, kind == "telemetry"
                )
                if LINKS[step["link"]].bus == "serial":
                    sent = [SerialLine(definition).encode(request).hex(" ")]
                else:
                    sent = [str(CanFrame(*frame)) for frame in can.frames_of(request, HOST, 4)]
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
