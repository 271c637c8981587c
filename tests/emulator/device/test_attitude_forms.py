"""The forms of the reported attitude, against scipy's rotations."""

import math
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from starhil.emulator.device.quantities import getter_of
from starhil.emulator.device.reported import SEQUENCES, Reported
from starhil.emulator.truth.source import FixedTruth
from starid.attitude import Attitude, random_attitude

ATTITUDE = Attitude.from_radec_roll(251.3, 38.7, 200.0)
AXES = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])
"""Components of the sensor's axes x, y and z in a unit with `axes = ["+y", "+z", "+x"]`."""
TOLERANCE = 1e-9
NARROW = 1e-4
"""Rounding of a 32-bit field, degrees."""


def rotation_of(attitude: Attitude) -> Rotation:
    """The rotation that takes a vector's components from ICRS to the frame."""
    return Rotation.from_quat(attitude.quaternion_xyzw)


def turn_of(attitude: Attitude) -> Rotation:
    """The rotation that turns the axes of ICRS to those of the frame."""
    return rotation_of(attitude).inv()


@pytest.mark.parametrize("sequence", SEQUENCES)
def test_the_euler_angles_of_every_sequence_turn_the_axes_to_the_frame(sequence):
    rng = np.random.default_rng(1)
    proper = sequence[0] == sequence[2]
    for _ in range(200):
        attitude = random_attitude(rng)
        angles = Reported("ok", attitude=attitude).euler_rad(sequence)
        turned = Rotation.from_euler(sequence.upper(), angles)
        assert (turned.inv() * turn_of(attitude)).magnitude() < TOLERANCE
        low, high = (0.0, math.pi) if proper else (-0.5 * math.pi, 0.5 * math.pi)
        assert low <= angles[1] <= high
        assert angles == pytest.approx(turn_of(attitude).as_euler(sequence.upper()), abs=TOLERANCE)


@pytest.mark.parametrize("sequence", SEQUENCES)
@pytest.mark.parametrize("end", [0, 1])
def test_euler_angles_at_gimbal_lock_leave_the_third_rotation_out(sequence, end):
    proper = sequence[0] == sequence[2]
    second = (0.0, math.pi)[end] if proper else (-0.5 * math.pi, 0.5 * math.pi)[end]
    turn = Rotation.from_euler(sequence.upper(), (0.7, second, -0.2))
    first, middle, third = Reported("ok", attitude=Attitude(turn.inv().as_quat())).euler_rad(sequence)
    assert third == 0.0
    assert (Rotation.from_euler(sequence.upper(), (first, middle, third)).inv() * turn).magnitude() < 1e-7


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_rotation_gibbs_and_rodrigues_vector_are_those_of_the_quaternion(sign):
    rng = np.random.default_rng(2)
    for _ in range(200):
        q = sign * random_attitude(rng).quaternion_xyzw
        vector = Reported("ok", tuple(q.tolist())).rotation_vector_rad
        assert vector == pytest.approx(Rotation.from_quat(q).as_rotvec(), abs=TOLERANCE)
        assert Reported("ok", tuple(q.tolist())).gibbs_vector == pytest.approx(tuple(q[:3] / q[3]))
        parameters = Reported("ok", tuple(q.tolist())).modified_rodrigues
        assert parameters == pytest.approx(Rotation.from_quat(q).as_mrp(), abs=TOLERANCE)
    assert Reported("ok", (0.0, 0.6, -0.8, sign * 0.0)).gibbs_vector == pytest.approx(
        (0.0, sign * 6e11, sign * -8e11)
    )
    assert Reported("ok", (0.0, 0.0, 0.0, sign)).rotation_vector_rad == (0.0, 0.0, 0.0)


FORMS = {
    **{f"dcm_{axis}{n}": (f"attitude.dcm_{axis}[{n}]", "") for axis in "xyz" for n in (1, 2, 3)},
    **{f"euler{n}": (f"attitude.euler_zyx[{n}]", "deg") for n in (1, 2, 3)},
    **{f"rotation_{axis}": (f"attitude.rotation_{axis}", "rad") for axis in "xyz"},
    **{f"{form}_{axis}": (f"attitude.{form}_{axis}", "") for form in ("gibbs", "mrp") for axis in "xyz"},
    "ra": ("attitude.ra", "deg"),
    "dec": ("attitude.dec", "rad"),
    "roll": ("attitude.roll", "deg"),
}  # fmt: skip
"""Name of a field → its quantity and unit."""

FIELDS = ", ".join(
    f'{{ name = "{name}", type = "f64", value = "{value}", unit = "{unit}" }}' if unit else
    f'{{ name = "{name}", type = "f64", value = "{value}" }}'
    for name, (value, unit) in FORMS.items()
)  # fmt: skip

UNIT = f"""
[unit]
name = "x"
version = "1"
doc = "d"

[conventions]
axes = ["+y", "+z", "+x"]
quaternion = "attitude"

[[telecommand]]
id = 100
name = "start"
doc = "d"
provenance = "ours"
action = "set_mode"
arguments = {{ mode = "lost_in_space" }}

[[telemetry]]
id = 1
name = "forms"
doc = "d"
provenance = "ours"
fields = [{FIELDS}]
"""


@pytest.fixture
def bench_of_forms(tmp_path: Path, make_bench):
    """A device whose row has the attitude in every form, in a frame of its own."""
    (tmp_path / "unit.toml").write_text(UNIT, encoding="utf-8")
    return make_bench(unit=str(tmp_path), truth=FixedTruth(ATTITUDE)).start()


def test_a_row_reports_the_attitude_in_every_form(bench_of_forms):
    bench_of_forms.command("start")
    bench_of_forms.step(2.5)
    row = bench_of_forms.read("forms")
    matrix = AXES @ rotation_of(ATTITUDE).as_matrix()
    assert [row[f"dcm_{axis}{n}"] for axis in "xyz" for n in (1, 2, 3)] == pytest.approx(matrix.ravel())
    angles = Rotation.from_matrix(matrix.T).as_euler("ZYX", degrees=True)
    assert [row[f"euler{n}"] for n in (1, 2, 3)] == pytest.approx(angles)
    turn = Rotation.from_matrix(matrix).inv()  # the convention "attitude" is the inverse
    assert [row[f"rotation_{axis}"] for axis in "xyz"] == pytest.approx(turn.as_rotvec())
    assert [row[f"mrp_{axis}"] for axis in "xyz"] == pytest.approx(turn.as_mrp())
    half_angle = 0.5 * turn.magnitude()
    assert [row[f"gibbs_{axis}"] for axis in "xyz"] == pytest.approx(
        turn.as_rotvec() / turn.magnitude() * math.tan(half_angle)
    )
    assert (row["ra"], row["dec"], row["roll"]) == pytest.approx((251.3, math.radians(38.7), 200.0))


def test_the_mounting_angles_turn_right_ascension_declination_and_roll(make_bench):
    bench = make_bench(truth=FixedTruth(ATTITUDE)).start()
    bench.command("set_parameter", parameter=20, value=10.0)
    bench.command("set_mode", mode="lost_in_space")
    bench.step(2.5)
    snapshot = bench.device.snapshot()
    mounted = Attitude(
        (rotation_of(ATTITUDE).inv() * Rotation.from_euler("x", 10.0, degrees=True)).inv().as_quat()
    )
    measured = [getter_of(f"attitude.{name}")(snapshot) for name in ("ra", "dec", "roll")]
    assert measured == pytest.approx([mounted.ra_deg, mounted.dec_deg, mounted.roll_deg], abs=NARROW)


def test_without_a_valid_attitude_every_form_is_zero(bench_of_forms):
    assert set(bench_of_forms.read("forms").values()) == {0.0}
