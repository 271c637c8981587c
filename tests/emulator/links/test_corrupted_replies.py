"""How many corrupted replies look good to a careful OBC, on a serial line without a checksum."""

from __future__ import annotations

import math

import pytest

from starhil.emulator.profile import Profile
from starhil.protocol.icd.values import MessageError
from starhil.protocol.messages import Reply
from starhil.protocol.serial.stack import SerialStack


@pytest.mark.parametrize(("unit", "least", "most"), [("cubestar", 0.75, 0.85), ("st200", 0.0, 0.01)])
def test_share_of_single_bit_errors_that_look_good(make_bench, unit, least, most):
    bench = make_bench(Profile(parameters={"start_mode": "lost_in_space"}), unit=unit).start()
    bench.step(3.0)
    row = bench.icd.telemetry["precise_attitude"] if unit == "cubestar" else bench.icd.readable[0]
    request = bench.icd.request(row)
    stack = SerialStack(bench.icd)
    (reply,) = bench.requests.handle(request)
    line = stack.encode_reply(reply)
    true = row.decode(reply.data)
    good = 0
    for bit in range(8 * len(line)):
        host = stack.host()
        host.request(request)
        received = bytearray(line)
        received[bit // 8] ^= 1 << bit % 8
        events = [*host.feed(bytes(received), 0.0), *host.flush(10.0)]
        good += any(isinstance(event, Reply) and looks_good(row, event.data, true) for event in events)
    share = good / (8 * len(line))
    print(f"{unit}: {100.0 * share:.0f} % of {8 * len(line)} single-bit errors look good")
    assert least <= share <= most


def looks_good(row, data: bytes, true: dict) -> bool:
    """Return whether a careful OBC believes a reply: length, limits, quaternion, and its time against the OBC's clock."""
    try:
        values = row.decode(data, check=True)
    except MessageError:
        return False
    if "time_of_exposure" not in values:
        return True
    is_rotation = abs(math.hypot(*(values[f"q_{part}"] for part in "xyzw")) - 1.0) < 0.01
    return is_rotation and abs(values["time_of_exposure"] - true["time_of_exposure"]) < 5.0
