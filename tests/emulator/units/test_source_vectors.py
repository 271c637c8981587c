"""Rows against bytes worked out by hand from the public source of each: order, types, scales and defaults.

A test that sets a row and reads it back does not see two fields exchanged, or a scale that both ends share; these bytes do.
"""

from __future__ import annotations

import struct

import pytest

from starhil.protocol.messages import Request
from starhil.protocol.unit import load_unit
from tests.emulator.conftest import Bench


def test_star_performance_and_timing_are_in_the_order_of_the_driver() -> None:
    """AlbertaSat/ex2_obc_software, adcs_handler.c, ADCS_get_star_tracker: bytes 0 to 5, and u16 36, 38, 40 in ms.

    Detected, noise, invalid, identified, mode (0: tracking), dark; capture, detection, identification.
    """
    bench = Bench().start()
    bench.command("set_mode", mode="lost_in_space")
    bench.step(3.0)

    def read(number: int) -> bytes:
        (reply,) = bench.requests.handle(Request.of(number))
        return reply.data

    found = bench.pipeline.frames[-1]
    assert found.predicted is not None  # tracking
    assert read(188) == bytes((40, 6, 3, 35, 0, 8))
    assert read(211)[:6] == read(188)
    exposure_ms = 100
    capture, detection, identification = struct.unpack("<3H", read(189))
    timing = bench.device.profile.timing
    assert capture == exposure_ms + round(1e3 * timing.readout_s)
    assert detection == round(1e3 * (timing.detect_s + 40 * timing.detect_per_star_s))
    assert identification < detection < capture
    assert read(211)[36:42] == read(189)


@pytest.mark.parametrize(
    ("unit", "row", "values", "expected"),
    [
        # ut-issl/c2a-aobc, sagitta.c, SAGITTA_set_lisa: u32 mode, ten f32, two u8, f32
        (
            "sagitta",
            "set_lisa",
            {
                "mode": 1, "distance_threshold": 2.0, "angle_threshold": 3.0, "field_width": 4.0, "field_height": 5.0,
                "float_star_limit": 6.0, "close_star_limit": 7.0, "weight_close_count": 8.0, "weight_close_fraction": 9.0,
                "weight_mean": 10.0, "weight_database": 11.0, "max_combinations": 12, "stars_to_stop": 13,
                "close_fraction_to_stop": 14.0,
            },
            "01000000 00000040 00004040 00008040 0000A040 0000C040 0000E040 00000041 00001041 00002041 00003041 0C 0D 00006041",
        ),
        # the defaults of sagitta.c up to commit 4e26d9c: 2, 0.2, 0.1, 0.443161868784811 twice, 0.08 twice, 100, 10, 0, 0, 12, 6, 0.5
        (
            "sagitta",
            "set_lisa",
            {},
            "02000000 CDCC4C3E CDCCCC3D 1DE6E23E 1DE6E23E 0AD7A33D 0AD7A33D 0000C842 00002041 00000000 00000000 0C 06 0000003F",
        ),
        # SkCubeSat/Software, cubespace-adcs-api/src/commands.rs, WHEEL_CONFIGURATION_COMMAND_FIELDS: at bit 96 n inertia, at
        # 96 n + 32 maximum momentum, at 96 n + 64 maximum torque; 384 ramp torque, 416 scheme, 424 failed wheel, 432 and 464
        (
            "cubestar-gen2",
            "set_wheel_configuration",
            {
                **{f"inertia_{n}": 1.0 for n in range(4)},
                "momentum_limit_0": 2.0, "torque_limit_0": 3.0, "momentum_limit_1": 4.0, "torque_limit_1": 5.0,
                "momentum_limit_2": 6.0, "torque_limit_2": 7.0, "momentum_limit_3": 8.0, "torque_limit_3": 9.0,
                "ramp_torque": 10.0, "scheme": 11, "failed_wheel": 12, "pyramid_momentum": 13.0, "pyramid_tilt": 14.0,
            },
            "0000803F 00000040 00004040 0000803F 00008040 0000A040 0000803F 0000C040 0000E040 0000803F 00000041 00001041 00002041 0B 0C 00005041 00006041",
        ),
        # the same, magnetometer 0: (raw parameter) = (formatted value) * 1000, i16: offsets 1 to 3, S11 S22 S33 S12 S13 S21 S23 S31 S32
        (
            "cubestar-gen2",
            "set_mag0_calibration",
            {
                "offset_1": 0.001, "offset_2": -0.002, "offset_3": 1.0, "s11": 0.004, "s22": 0.005, "s33": 0.006, "s12": 0.007,
                "s13": 0.008, "s21": 0.009, "s23": 0.010, "s31": 0.011, "s32": -32.768,
            },
            "0100 FEFF E803 0400 0500 0600 0700 0800 0900 0A00 0B00 0080",
        ),
        # the same, telemetry.rs, MAG0 and MAG1 vectors: [uT] = RAWVAL * 0.01 from bit 64 on, the flags from bit 160 on
        (
            "cubestar-gen2",
            "magnetometer_raw",
            {
                "mag0_x": 0.01, "mag0_y": -0.02, "mag0_z": 0.03, "mag1_x": 0.04, "mag1_y": 0.05, "mag1_z": 327.67,
                "mag0_valid": False, "mag1_valid": True,
            },
            "00000000 00000000 0100 FEFF 0300 0400 0500 FF7F 02",
        ),
        (
            "cubestar-gen2",
            "magnetometer_calibrated",
            {"mag0_x": 0.01, "mag1_z": -0.01, "mag1_valid": True, "mag0_best": True},
            "00000000 00000000 0100 0000 0000 0000 0000 FFFF 06",
        ),
        # oresat/oresat-configs, base/star_tracker.yaml, 4003h: enable, lower bound and percentage, upper bound and percentage
        (
            "oresat",
            "set_capture_filter",
            {"enable": 0, "lower_bound": 1, "lower_percentage": 2, "upper_bound": 3, "upper_percentage": 100},
            "00 01 02 03 64",
        ),
        ("oresat", "set_capture_filter", {}, "01 00 00 00 00"),
        # oresat1/star_tracker_overlay.yaml, 4001h sub-index 2: u32, 100 ms
        ("oresat", "set_capture_delay", {}, "64000000"),
    ],
)  # fmt: skip
def test_a_row_has_the_bytes_of_its_source(unit: str, row: str, values: dict, expected: str) -> None:
    icd = load_unit(unit)
    found = icd.telecommands[row] if row in icd.telecommands else icd.telemetry[row]
    given = {**found.example(), **values}
    assert found.encode(given) == bytes.fromhex(expected)
