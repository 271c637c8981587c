"""What a page controls: faults, scenarios, truth and clock."""

import pytest

from starhil.emulator.console.describe import fault_controls
from starhil.emulator.run.faults import DeviceFault
from starhil.protocol.unit import load_unit
from tests.emulator.console.pages import ALONG_X, OPTIONS, Page

pytestmark = [pytest.mark.long, pytest.mark.usefixtures("prompt_pages")]


def test_faults_scenarios_and_truth_are_set_from_the_page_and_nothing_else(run):
    async def scenario(emulation, _line):
        await emulation.stepper.step(5.0)
        async with Page(emulation) as page:
            answer = await page.ask(do="control", request={"do": "fault", "optical": {"blank": True}})
            assert answer["faults"] == {"optical": {"blank": True}}
            status = await page.message("status", lambda item: item["status"]["faults"])
            assert status["status"]["faults"] == {"optical": {"blank": True}}
            wrong = await page.ask(do="control", request={"do": "fault", "optical": {"moon": 3}})
            assert wrong["error"].startswith("optical")
            assert (
                "request: do must be one of"
                in (await page.ask(do="control", request={"do": "quit"}))["error"]
            )
            assert (await page.ask(do="control", request=3))["error"] == "request: must be an object"
            assert "do: must be one of" in (await page.ask(do="fly"))["error"]
            assert (await page.ask(do="control", request={"do": "clear_faults"}))["faults"] == {}
            slew = await page.ask(do="point", kind="slew", to={"star": "rigel"}, max_rate_deg_s=2.0)
            assert slew["kind"] == "slew"
            await emulation.stepper.step(60.0)
            truth = await page.ask(do="control", request={"do": "truth"})
            assert (truth["ra_deg"], truth["dec_deg"]) == pytest.approx((78.634, -8.202), abs=0.01)
            unknown = await page.ask(do="point", kind="slew", to={"star": "Nibiru"})
            assert unknown["error"].startswith("star 'Nibiru': unknown")

    run(scenario, options=OPTIONS)


def test_every_fault_of_the_device_has_a_control_with_the_values_that_it_takes():
    icd = load_unit()
    device = next(level["controls"] for level in fault_controls(icd, ["can"]) if level["level"] == "device")
    controls = {control["name"]: control for control in device}
    upset = {control["name"]: control for control in controls.pop("upset")["controls"]}
    assert upset["parameter"]["values"] == list(icd.device_parameters)
    assert (upset["bit"]["kind"], upset["bit"]["min"], upset["bit"]["max"]) == ("integer", 0, 63)
    assert (upset["star"]["kind"], upset["star"]["max"]) == ("integer", 200_000)
    assert controls["stuck"]["kind"] == "flag"
    assert set(controls) == set(DeviceFault.model_fields) - {"upset"}
    choices = [control for control in controls.values() if control["kind"] == "choice"]
    assert {"error", "reset"} <= {control["name"] for control in choices}
    assert all(control["values"] for control in choices)


def test_a_scenario_from_the_page_starts_now(run, tmp_path):
    path = tmp_path / "later.toml"
    path.write_text('name = "later"\n[[at]]\nrun_time_s = 2.0\nfault = { optical = { blank = true } }\n')

    async def scenario(emulation, _line):
        await emulation.stepper.step(10.0)
        async with Page(emulation) as page:
            assert (await page.ask(do="control", request={"do": "scenario", "name": str(path)}))[
                "events"
            ] == 1
            await emulation.stepper.step(1.9)
            assert run.first_head().faults.describe() == {}
            await emulation.stepper.step(0.2)
            assert run.first_head().faults.describe() == {"optical": {"blank": True}}
            missing = await page.ask(do="control", request={"do": "scenario", "name": "no_such"})
            assert "not found" in missing["error"]

    run(scenario, options=OPTIONS)


def test_the_stepped_clock_runs_until_it_is_paused(run):
    async def scenario(emulation, _line):
        async with Page(emulation) as page:
            assert (await page.ask(do="clock", speed=10))["speed"] == 10
            await page.message("status", lambda item: item["status"]["run_time_s"] > 2.0)
            assert (await page.ask(do="clock", speed=0))["speed"] == 0
            assert (await page.ask(do="clock", speed=1000))["error"] == "speed: 1000 is outside 0 … 100"

    run(scenario, options=OPTIONS)


def test_a_clock_that_passes_by_itself_cannot_be_stopped(run):
    async def scenario(emulation, _line):
        async with Page(emulation) as page:
            assert (await page.ask(do="clock", speed=1))["error"] == "the clock is real and cannot be stopped"

    run(scenario, clock="real", options=OPTIONS)


@pytest.mark.parametrize("mount", [None, ALONG_X])
def test_the_sensor_points_turns_and_stops_as_the_page_asks_with_any_mount(run, mount):
    async def scenario(emulation, _line):
        await emulation.stepper.step(1.0)
        async with Page(emulation) as page:

            async def truth():
                return await page.ask(do="control", request={"do": "truth"})

            begin = (await truth())["quaternion_xyzw"]
            await page.ask(do="point", kind="rate", rate_deg_s=[0.1, 0.2, 0.3])
            turning = await truth()
            assert turning["quaternion_xyzw"] == pytest.approx(begin)
            assert turning["rate_deg_s"] == pytest.approx([0.1, 0.2, 0.3])
            await emulation.stepper.step(10.0)
            before = (await truth())["quaternion_xyzw"]
            await page.ask(do="point", kind="fixed", to={})
            assert (await truth())["quaternion_xyzw"] == pytest.approx(before)
            await page.ask(do="point", kind="fixed", to={"ra_deg": 10.0, "dec_deg": 20.0, "roll_deg": 30.0})
            still = await truth()
            assert [still[f"{name}_deg"] for name in ("ra", "dec", "roll")] == pytest.approx(
                [10.0, 20.0, 30.0]
            )
            wrong = await page.ask(do="point", kind="fixed", to={"ra_deg": 10.0, "dec_deg": 95.0})
            assert "dec_deg" in wrong["error"]
            assert "kind" in (await page.ask(do="point", kind="fly"))["error"]
            assert "rate_deg_s" in (await page.ask(do="point", kind="rate", rate_deg_s=[1.0]))["error"]

    run(scenario, options=OPTIONS, truth={"kind": "fixed", "mount": mount} if mount else {"kind": "fixed"})
