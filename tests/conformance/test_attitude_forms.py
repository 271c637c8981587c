"""All attitudes in a row are judged: by their length, by the truth, and by each other."""

from __future__ import annotations

import re
import shutil
from itertools import permutations, product
from pathlib import Path

import pytest
from pydantic import ValidationError

from starhil.emulator.truth.source import FixedTruth
from starhil.hil_tests.attitude import as_reported, conjugate, from_radec_roll, from_reported
from starhil.hil_tests.conformance.attitude_forms import angle_deg, axes_of
from starhil.hil_tests.conformance.conformance_run import POINTING
from starhil.hil_tests.conformance.runner import run_case
from starhil.hil_tests.conformance.suites import serial_suite
from starhil.hil_tests.judge.definition import read_unit
from starhil.protocol.files.bundled import find_unit
from starhil.protocol.icd.conventions import Conventions
from starid.attitude import Attitude
from tests.conformance.links import LINKS, ROWS
from tests.conformance.simulated import SimulatedUnit

pytestmark = pytest.mark.long

RADEC_ROLL = (211.0, 48.0, 77.0)
TRUTH = from_radec_roll(*RADEC_ROLL)
HALF_TURN = from_radec_roll(91.0, 0.0, 180.0)
ANOTHER = from_radec_roll(211.0, 48.0, 82.0)
EULER = tuple(a + b + end for a, b, c in permutations("xyz") for end in (a, c))
FORMS = {
    "quaternion": [f"f32 q_{part} - attitude.{part}" for part in "wxyz"],
    "copy": [f"f64 copy_{part} - attitude.{part}" for part in "xyzw"],
    "vector": [f"i16 v_{part} - 0.0001 attitude.{part}" for part in "xyz"],
    "rotation": [f"f32 r_{part} deg attitude.rotation_{part}" for part in "xyz"],
    "gibbs": [f"f32 g_{part} - attitude.gibbs_{part}" for part in "xyz"],
    "mrp": [f"i16 p_{part} - 0.0001 attitude.mrp_{part}" for part in "xyz"],
    "radec": ["u16 ra deg 0.01 attitude.ra", "i32 dec arcsec attitude.dec", "f32 roll rad attitude.roll"],
    "boresight": ["f32 ra_2 deg attitude.ra", "f32 dec_2 deg attitude.dec"],
    **{f"dcm_{axis}": [f"f32 dcm_{axis}{n} - attitude.dcm_{axis}[{n}]" for n in (1, 2, 3)] for axis in "xyz"},
    **{f"euler_{s}": [f"f32 {s}_{n} deg attitude.euler_{s}[{n}]" for n in (1, 2, 3)] for s in EULER},
}  # fmt: skip
"""Fields of each form: type, name, unit, scale if not 1, and quantity."""
CONVENTIONS = ('quaternion = "rotation"', 'quaternion = "attitude"\naxes = ["-y", "+x", "+z"]')


def field(text: str, scale: float = 1.0) -> str:
    """Write a field, whose values may be scaled by a factor more."""
    type_, name, unit, *own, quantity = text.split()
    factor = scale * float(own[0] if own else 1.0)
    unit = "" if unit == "-" else f'unit = "{unit}", '
    return f'{{ name = "{name}", type = "{type_}", {unit}scale = {factor}, value = "{quantity}" }}'


def write(
    folder: Path, name: str, conventions: str, scales: dict[str, float] | None = None, flag: str = ""
) -> Path:
    """Write a unit with a row of all forms; `scales` multiply the values of fields by name."""
    scales = scales or {}
    fields = [field(text, scales.get(text.split()[1], 1.0)) for form in FORMS.values() for text in form]
    flag = flag or '{ name = "valid", type = "u8", map = { 0 = false, 1 = true }, value = "attitude.valid" }'
    row = f"""[[telemetry]]
id = 140
name = "forms"
doc = "All forms of the attitude."
fields = [
    {flag},
    {", ".join(fields)}
]

[link.serial]
"""
    text = ROWS.format(name="forms", order="big").replace(
        "[conventions]\n", f"[conventions]\n{conventions}\n"
    )
    place = folder / name
    place.mkdir()
    (place / "unit.toml").write_text(
        text.removesuffix("[link.serial]\n") + row + LINKS["sum"], encoding="utf-8"
    )
    return place


def outcome_of(case: str, unit: str | Path, served: Path | None, truth=None, pointed=RADEC_ROLL):
    cases = {item.id: item for item in serial_suite(read_unit(unit))}

    def point(simulated):
        simulated.device.surroundings.truth = FixedTruth(Attitude.from_radec_roll(*pointed))

    with SimulatedUnit("serial", point, unit=unit, served=served) as simulated:
        simulated.probe.truth = truth and (lambda: truth)
        return run_case(simulated.probe, cases[f"serial.{case}"])


@pytest.mark.parametrize("conventions", CONVENTIONS)
@pytest.mark.parametrize("case", ["attitude.forms", "telemetry.forms"])
def test_all_forms_are_the_truth_in_any_convention(conventions, case, tmp_path):
    unit = write(tmp_path, "unit", conventions)
    assert outcome_of(case, unit, None, TRUTH).status == "passed"
    assert outcome_of(case, unit, None, None).status == "passed"
    turned = outcome_of(case, unit, None, ANOTHER)
    assert (turned.status, turned.seen.endswith("5.00 deg off")) == ("failed", True)


@pytest.mark.parametrize("form", FORMS)
def test_a_wrong_field_of_any_form_fails_without_a_truth_too(form, tmp_path):
    unit = write(tmp_path, "unit", CONVENTIONS[0])
    name = FORMS[form][0].split()[1]
    served = write(tmp_path, "served", CONVENTIONS[0], {name: 0.5})
    outcome = outcome_of("telemetry.forms", unit, served)
    assert outcome.status == "failed"
    assert name in outcome.expected


def test_a_conjugated_quaternion_fails_beside_another_form(tmp_path):
    unit = write(tmp_path, "unit", CONVENTIONS[1])
    served = write(tmp_path, "served", CONVENTIONS[1], dict.fromkeys(("copy_x", "copy_y", "copy_z"), -1.0))
    outcome = outcome_of("telemetry.forms", unit, served)
    assert (
        outcome.expected == "the attitude of q_x, q_y, q_z, q_w in copy_x, copy_y, copy_z, copy_w, to 2 deg"
    )


def test_the_true_attitude_is_stated_as_the_row_reports_it(tmp_path):
    unit = write(tmp_path, "unit", CONVENTIONS[0])
    first = outcome_of("telemetry.forms", unit, None, ANOTHER)
    assert re.match(r"the true attitude \(.*, 0\.[0-9]+\) in q_x, q_y, q_z, q_w,", first.expected)
    served = write(tmp_path, "served", CONVENTIONS[0], {"roll": 0.5})
    angles = outcome_of("telemetry.forms", unit, served, TRUTH)
    assert angles.expected.startswith(
        "the true attitude RA 211.0 deg, Dec 48.0 deg, roll 77.0 deg in ra, dec, roll,"
    )


def test_a_truth_that_its_conjugate_resembles_is_named(tmp_path):
    """The rotation from ICRS to this attitude is nearly half a turn."""
    outcome = outcome_of("attitude.solution", "sagitta", None, HALF_TURN, (91.0, 0.0, 180.0))
    assert (outcome.status, outcome.seen) == (
        "skipped",
        "a conjugated attitude would pass too: at this truth it is only 1.41 deg off; point the unit elsewhere",
    )


@pytest.mark.parametrize("order", list(permutations("xyz")))
def test_where_a_started_emulator_points_no_conjugate_resembles_the_truth(order):
    for signs in product("+-", repeat=3):
        axes = [sign + axis for sign, axis in zip(signs, order, strict=True)]
        try:
            conventions = Conventions(axes=axes)
        except ValidationError:
            continue  # a left-handed frame
        turned = from_reported(conjugate(as_reported(POINTING, conventions)), conventions)
        assert angle_deg(axes_of(turned), axes_of(POINTING)) > 19.0


@pytest.mark.parametrize("sign", ["positive", "any"])
def test_a_negative_scalar_part_fails_where_its_sign_is_fixed(sign, tmp_path):
    conventions = f'{CONVENTIONS[0]}\nscalar_sign = "{sign}"'
    unit = write(tmp_path, "unit", conventions)
    served = write(tmp_path, "served", conventions, dict.fromkeys(("q_w", "q_x", "q_y", "q_z"), -1.0))
    outcome = outcome_of("attitude.forms", unit, served, TRUTH)
    assert outcome.status == ("failed" if sign == "positive" else "passed")
    if sign == "positive":
        assert outcome.expected == "q_w not negative (R15, docs/rules.md)"


def test_a_row_without_a_flag_is_judged_unless_it_is_zeros(tmp_path):
    flag = '{ name = "valid", type = "u8", const = 0 }'
    unit = write(tmp_path, "unit", CONVENTIONS[0], flag=flag)
    served = write(tmp_path, "served", CONVENTIONS[0], {"q_w": 0.5}, flag)
    assert outcome_of("attitude.forms", unit, None, TRUTH).status == "passed"
    assert outcome_of("attitude.forms", unit, served).status == "failed"


def sagitta(folder: Path, old: str, new: str) -> Path:
    """Copy the unit `sagitta` with another text in its telemetry."""
    served = Path(shutil.copytree(find_unit("sagitta"), folder / "sagitta"))
    telemetry = served / "30-telemetry.toml"
    text = telemetry.read_text(encoding="utf-8")
    assert old in text
    telemetry.write_text(text.replace(old, new), encoding="utf-8")
    return served


@pytest.mark.parametrize("name", ["q_w", "track_w", "lisa_w"])
@pytest.mark.parametrize("case", ["telemetry.solution", "attitude.solution"])
def test_each_quaternion_of_a_row_is_judged(name, case, tmp_path):
    served = sagitta(tmp_path, f'"{name}", type = "f32"', f'"{name}", type = "f32", scale = 2')
    outcome = outcome_of(case, "sagitta", served)
    assert outcome.status == "failed"
    assert outcome.expected.startswith(f"a quaternion of length 1 in {name.replace('w', 'x')}")


def test_an_inverted_flag_fails_where_the_truth_is_known(tmp_path):
    inverted = 'value = "attitude.valid", map = { 1 = false, 0 = true }'
    served = sagitta(tmp_path, 'value = "attitude.valid", map = { 0 = false, 1 = true }', inverted)
    outcome = outcome_of("attitude.solution", "sagitta", served, TRUTH)
    assert outcome.status == "failed"
    assert outcome.expected == "valid set within 20 s, because the reported attitude is the true one"
    assert outcome_of("attitude.solution", "sagitta", served, ANOTHER).status == "skipped"
