"""The thermal model follows the update rate; the bit rate of a profile comes from the unit unless it is given."""

from dataclasses import replace

import pytest

from starhil.emulator.device import quantities
from starhil.emulator.device.device import profile_defaults
from starhil.emulator.profile import Profile
from starhil.protocol.unit import load_unit

HOT = {"thermal": {"heating_c_w": 20.0, "time_constant_s": 5.0}, "parameters": {"update_rate": 0.1}}


def test_a_higher_update_rate_heats_the_detector(make_bench):
    bench = make_bench(Profile.model_validate(HOT)).start()
    bench.command("set_mode", mode="lost_in_space")
    bench.step(40.0)
    slow = bench.read("health")
    bench.command("set_update_rate", rate=2.0)
    bench.step(40.0)
    fast = bench.read("health")
    rise = fast["detector_temperature"] - slow["detector_temperature"]
    assert rise == pytest.approx(20.0 * (fast["mean_power"] - slow["mean_power"]), abs=0.05)
    assert rise > 0.5


@pytest.mark.parametrize(("links", "baud"), [({}, 57600), ({"serial": {"baud": 9600}}, 9600)])
def test_the_bit_rate_is_that_of_the_unit_unless_the_profile_gives_one(links, baud):
    icd = load_unit("sagitta")
    serial = icd.link.serial.model_copy(update={"baud": 57600})
    changed = replace(icd, link=icd.link.model_copy(update={"serial": serial}))
    assert profile_defaults(Profile.model_validate({"links": links}), changed)["serial_baud"] == baud


def test_a_quantity_that_is_declared_twice_is_an_error():
    """The second function would replace the first, and change the rows that report it."""
    with pytest.raises(ValueError, match=r"frame\.late has two functions"):
        quantities._quantity("frame.late", lambda _shot: True)
