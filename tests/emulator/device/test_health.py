"""Phase, power and temperature in telemetry."""

import math

import pytest

from starhil.emulator.profile import Profile
from starhil.protocol.files.bundled import bundled_units

HOT = {
    "thermal": {
        "mounting_c": 10.0,
        "swing_c": 15.0,
        "period_s": 400.0,
        "heating_c_w": 20.0,
        "time_constant_s": 50.0,
    }
}
PUBLISHED = {
    "timing": {"readout_s": 0.02, "detect_s": 0.118, "identify_lost_s": 0.05, "identify_tracking_s": 0.05},
    "parameters": {"exposure": 200, "update_rate": 1.0},
}
STEP_S = 0.004


def published_bench(make_bench):
    return make_bench(Profile.model_validate(PUBLISHED)).start()


def test_currents_follow_the_phases_of_a_frame(make_bench):
    bench = published_bench(make_bench)
    bench.command("set_mode", mode="lost_in_space")
    bench.step(2.0)
    lasting_s: dict[tuple[str, float], float] = {}
    for _ in range(round(3.0 / STEP_S)):
        row = bench.read("health")
        key = (row["phase"], round(row["current"], 1))
        lasting_s[key] = lasting_s.get(key, 0.0) + STEP_S / 3.0
        assert row["power"] == pytest.approx(3.3 * row["current"] / 1000.0, abs=0.001)
        bench.step(STEP_S)
    assert lasting_s == {
        ("idle", 71.0): pytest.approx(0.140, abs=2 * STEP_S),
        ("imager_on", 121.0): pytest.approx(0.068, abs=2 * STEP_S),
        ("exposure", 177.0): pytest.approx(0.388, abs=2 * STEP_S),
        ("transfer", 82.0): pytest.approx(0.404, abs=2 * STEP_S),
    }
    assert bench.read("health")["mean_power"] == pytest.approx(0.396, abs=0.001)


def test_a_fast_cycle_leaves_out_idling_and_then_the_transfer(make_bench):
    bench = published_bench(make_bench)
    bench.command("set_update_rate", rate=2.0)
    bench.command("set_mode", mode="lost_in_space")
    bench.step(2.0)
    values = set()
    for _ in range(250):
        values.add(bench.read("health")["phase"])
        bench.step(STEP_S)
    assert values == {"imager_on", "exposure", "transfer"}


def test_without_frames_the_unit_idles(bench):
    row = bench.read("health")
    assert (row["phase"], row["current"]) == ("idle", 71.0)
    assert row["mean_power"] == pytest.approx(0.234, abs=0.001)


def test_the_temperature_follows_the_orbit_and_the_power(make_bench):
    bench = make_bench(Profile.model_validate(HOT)).start()
    bench.step(99.0)
    row = bench.read("health")
    assert row["mounting_temperature"] == pytest.approx(25.0, abs=0.1)
    rise = row["detector_temperature"] - row["mounting_temperature"]
    assert rise == pytest.approx(20.0 * 0.2343 * (1.0 - math.exp(-100.0 / 50.0)), abs=0.05)
    bench.command("set_mode", mode="lost_in_space")
    bench.step(400.0)
    row = bench.read("health")
    assert row["detector_temperature"] - row["mounting_temperature"] == pytest.approx(
        20.0 * row["mean_power"], abs=0.05
    )


def test_every_frame_is_made_at_the_temperature_of_its_time(make_bench):
    bench = make_bench(Profile.model_validate(HOT)).start()
    bench.command("set_mode", mode="lost_in_space")
    bench.step(150.0)
    temperatures = [request.temperature_c for request in bench.pipeline.frames]
    assert max(temperatures) - min(temperatures) > 10.0
    assert bench.read("health")["detector_temperature"] == pytest.approx(temperatures[-1], abs=0.5)


def test_a_rate_above_the_limit_is_flagged(make_bench):
    truth = {"kind": "rate", "rate_deg_s": [0.0, 0.6, 0.0]}
    profile = Profile.model_validate({"truth": truth, "parameters": {"max_rate": 0.5}})
    bench = make_bench(profile, truth=profile.truth.build(0.0, profile.folder)).start()
    bench.command("set_mode", mode="lost_in_space")
    bench.step(3.5)
    assert bench.read("precise_attitude")["reason"] == "rate_too_high"
    assert bench.read("health")["rate_too_high"]
    bench.command("set_parameter", parameter=bench.icd.parameters["max_rate"].id, value=2.0)
    bench.step(2.0)
    assert not bench.read("health")["rate_too_high"]


@pytest.mark.long
def test_particles_come_with_the_south_atlantic_anomaly(make_bench):
    orbit = {"kind": "kepler", "semi_major_axis_km": 6871.0, "inclination_deg": 97.4}
    profile = Profile.model_validate(
        {
            "orbit": orbit,
            "radiation": {"quiet_s": 1.0, "anomaly_s": 200.0},
            "parameters": {"update_rate": 0.02},
        }
    )
    bench = make_bench(profile).start()
    bench.command("set_mode", mode="lost_in_space")
    bench.step(43_200.0)
    rates = [request.particles_s for request in bench.pipeline.frames]
    assert min(rates) == pytest.approx(1.0, abs=1e-3)
    assert 50.0 < max(rates) <= 201.0
    assert 0.01 < sum(rate > 20.0 for rate in rates) / len(rates) < 0.2


def test_numbers_left_out_of_health_are_those_of_the_model(make_bench):
    given = {"mcu_current": 0.25, "fpga_temperature": 0.0}
    bench = make_bench(Profile.model_validate({"health": given}), unit="sagitta").start()
    power, temperature = bench.read("power"), bench.read("temperature")
    assert (power["mcu_current"], power["mcu_voltage"], power["fpga_18_voltage"]) == pytest.approx(
        (0.25, 3.3, 1.8)
    )
    assert temperature == {"mcu": 20.0, "cmos": 20.0, "fpga": 0.0}


def test_no_temperature_or_voltage_of_a_bundled_unit_is_zero_by_default(make_bench):
    for name in bundled_units():
        bench = make_bench(Profile.model_validate({}), unit=name).start()
        for row in bench.icd.telemetry.values():
            bound = [field for field in row.named_fields.values() if str(field.value).startswith("health.")]
            values = bench.read(row.name) if bound else {}
            assert [field.name for field in bound if not values[field.name]] == [], (name, row.name)
