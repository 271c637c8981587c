"""Several heads in one run: one truth and one clock, a mount, an address and a seed each."""

from __future__ import annotations

import numpy as np
import pytest

from starhil.emulator.errors import EmulatorError
from starhil.emulator.launch import RunOptions, path_of_head, with_own_seeds
from starhil.emulator.launch.emulator import check_heads
from starhil.emulator.profile import Profile
from starhil.hil_tests.client import AsyncObcClient
from starhil.hil_tests.client.links import CanHostLink
from tests.emulator.runs import Control
from tests.emulator.truth.simulators import RATE_DEG_S, Stub42, blocks_of_42
from tests.waiting import until

BORESIGHT_ALONG_X = {"matrix": [[0, 0, -1], [0, 1, 0], [1, 0, 0]]}
PARAMETERS = {"start_mode": "lost_in_space", "update_rate": 2.0}
BUS = "virtual:heads"


def head(address, **keys):
    links = {"serial": {"port": "off"}, "can": {"channel": BUS, "address": address}}
    return {"links": links, "parameters": PARAMETERS, **keys}


def test_two_heads_on_one_bus_report_one_turn_each_in_its_own_frame(run, tmp_path):
    async def scenario(emulation, line):
        stub = Stub42(blocks_of_42(51))
        await stub.connect(int(emulation.ready_fields["truth"].rpartition(":")[2]))
        read = []
        for address in (4, 5):
            client = AsyncObcClient(CanHostLink(BUS, device_address=address), emulation.icd)
            await client.start()
            values = await client.telemetry("precise_attitude")
            read.append((values["frame_counter"], [values[f"rate_{axis}"] for axis in "xyz"]))
            await client.close()
        return line, read

    truth = {"kind": "42", "role": "server", "port": 0}
    other = head(5, truth={"kind": "fixed", "mount": BORESIGHT_ALONG_X}, run={"clock": "stepped", "seed": 2})
    log = tmp_path / "truth.csv"
    options = RunOptions(truth_log=log)
    line, ((count, rate), (other_count, other_rate)) = run(
        scenario, options=options, others=[other], **head(4, truth=truth)
    )
    x, y, z = RATE_DEG_S
    assert count == other_count >= 8
    assert rate == pytest.approx([x, y, z], abs=0.01)
    assert other_rate == pytest.approx([-z, y, x], abs=0.01)
    assert "seed=1" in line
    assert "seed.2=2" in line
    assert "can.2=" in line
    rows = [path_of_head(log, number).read_text().count("\n") for number in (1, 2)]
    assert rows[0] == rows[1] > 8


def test_each_head_keeps_the_mount_of_its_profile(run):
    async def scenario(emulation, _line):
        async with Control(emulation) as control:
            return [(await control.do("truth", head=number))["rate_deg_s"] for number in (1, 2)]

    truth = {
        "kind": "rate",
        "rate_deg_s": [0.1, 0.2, 0.3],
        "mount": {"matrix": [[1, 0, 0], [0, 0, -1], [0, 1, 0]]},
    }
    other = head(5, truth={"kind": "fixed", "mount": BORESIGHT_ALONG_X})
    first, second = run(scenario, others=[other], **head(4, truth=truth))
    assert first == pytest.approx([0.1, -0.3, 0.2])
    assert second == pytest.approx([-0.3, 0.2, 0.1])


def test_the_control_channel_commands_each_head_and_changes_the_truth_of_all(run):
    async def scenario(emulation, _line):
        async with Control(emulation) as control:
            await control.do("step", seconds=3.0)
            await control.do("set_truth", head=2, truth={"kind": "rate", "rate_deg_s": [0.0, 0.0, 1.0]})
            await control.do("fault", head=2, device={"stuck": True})
            states = [await control.do("status", head=number) for number in (1, 2)]
            truths = [(await control.do("truth", head=number))["rate_deg_s"] for number in (1, 2)]
            bad = await control.do("status", head=3)
        return states, truths, bad

    other = head(5, truth={"kind": "fixed", "mount": BORESIGHT_ALONG_X})
    (first, second), truths, bad = run(
        scenario, options=RunOptions(control="auto"), others=[other], **head(4)
    )
    assert (first["heads"], first["faults"], second["faults"]) == (2, {}, {"device": {"stuck": True}})
    assert np.abs(np.array(truths)) == pytest.approx(np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0]]), abs=1e-9)
    assert bad == {"ok": False, "error": "head: must be 1 to 2, not 3"}


@pytest.mark.long
def test_heads_on_the_real_clock_expose_by_themselves(run):
    async def scenario(emulation, _line):
        await until(lambda: not any(each.device.cycle.published < 2 for each in emulation.heads))

    run(scenario, clock="real", others=[head(5)], **head(4))


def profile(**keys):
    return Profile.model_validate({"links": {"can": {"channel": "auto"}, **keys.pop("links", {})}, **keys})


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({}, "links.can.address is 4, as in"),
        ({"run": {"clock": "stepped"}}, "heads share a clock"),
        (
            {"links": {"can": {"channel": "auto", "address": 5}, "serial": {"port": "/dev/ttyUSB0"}}},
            "links.serial.port is /dev/ttyUSB0",
        ),
        (
            {"links": {"can": {"channel": "auto", "address": 5}, "canopen": {"node": 7}}},
            "links.canopen.node is 7",
        ),
        (
            {"links": {"can": {"channel": "auto", "address": 5}}, "run": {"state_dir": "/tmp/one"}},
            "run.state_dir is /tmp/one",
        ),
    ],
)
def test_heads_that_exclude_each_other_are_rejected_with_the_key(keys, message):
    first = profile(
        links={"serial": {"port": "/dev/ttyUSB0"}, "canopen": {"node": 7}}, run={"state_dir": "/tmp/one"}
    )
    with pytest.raises(EmulatorError, match=message):
        check_heads([first, profile(**keys)])


def test_heads_of_one_seed_get_another_each_and_so_no_common_noise():
    seeds = [each.run.seed for each in with_own_seeds([profile(), profile(), profile(run={"seed": 2})])]
    assert seeds == [1, 2, 3]
