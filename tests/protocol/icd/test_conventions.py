"""The numbers of the attitude convention: from the attitude, by formulas that are not the product's own."""

from __future__ import annotations

import re
import struct

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from starhil.protocol.errors import IcdError
from starhil.protocol.export import export
from starhil.protocol.icd.values import Section
from starhil.protocol.unit import load_unit
from starhil.protocol.unit.examples import examine
from starid.attitude import Attitude

ICD = load_unit()
SECTIONS = {section.heading: section for section in ICD.sections}
DIGITS = 0.6e-7


def last_cells(section: Section) -> dict[str, str]:
    return {row[0].partition(":")[0]: row[-1] for row in section.rows}


EXAMPLE = last_cells(SECTIONS["Attitude convention"])
OTHERS = last_cells(SECTIONS["Attitude in other programs"])


def numbers(cell: str) -> np.ndarray:
    return np.array([float(number) for number in cell.split(", ")])


def hamilton(p: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Hamilton's product of scalar-last quaternions, from ij = k."""
    vector = p[3] * q[:3] + q[3] * p[:3] + np.cross(p[:3], q[:3])
    return np.append(vector, p[3] * q[3] - p[:3] @ q[:3])


def textbook(q: np.ndarray) -> np.ndarray:
    """Attitude matrix A(q) of a textbook: (q4² - |q|²) I + 2 q qᵀ - 2 q4 [q×]."""
    x, y, z, w = q
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return (w * w - q[:3] @ q[:3]) * np.eye(3) + 2.0 * np.outer(q[:3], q[:3]) - 2.0 * w * cross


def direction(ra_deg: float, dec_deg: float) -> np.ndarray:
    ra, dec = np.radians([ra_deg, dec_deg])
    return np.array([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)])


MATRIX = np.array([numbers(EXAMPLE[f"C, row of {axis}"]) for axis in "xyz"])
Q = numbers(EXAMPLE["q"])


def test_the_example_is_the_attitude_that_it_names():
    attitude = Attitude.from_radec_roll(*numbers(EXAMPLE["attitude"]))
    assert attitude.quaternion_xyzw == pytest.approx(Q, abs=DIGITS)
    assert MATRIX[2] == pytest.approx(direction(83.8, -1.2), abs=DIGITS)


def test_the_quaternion_turns_vectors_into_the_sensor_frame():
    v, v_sensor = numbers(EXAMPLE["v, Betelgeuse in ICRS"]), numbers(EXAMPLE["v_sensor"])
    turned = hamilton(hamilton(Q, np.append(v, 0.0)), Q * [-1.0, -1.0, -1.0, 1.0])
    assert v == pytest.approx(direction(88.792939, 7.407064), abs=DIGITS)
    assert turned[:3] == pytest.approx(v_sensor, abs=4 * DIGITS)
    assert MATRIX @ v == pytest.approx(v_sensor, abs=4 * DIGITS)
    assert Rotation.from_quat(Q).apply(v) == pytest.approx(v_sensor, abs=4 * DIGITS)
    place = numbers(EXAMPLE["its position in the image"])
    assert 468.0 + 1220.4842 * v_sensor[:2] / v_sensor[2] == pytest.approx(place, abs=0.006)


def test_the_formulas_of_the_matrix_give_its_rows():
    x, y, z, w = Q
    for row in SECTIONS["Attitude convention"].rows:
        if row[0].startswith("C, row"):
            formula = re.sub(r"(\w+)²", r"\1**2", row[1])
            formula = re.sub(r"2\(", "2*(", re.sub(r"\b([xyzw])([xyz])\b", r"\1*\2", formula))
            values = eval(formula, {"x": x, "y": y, "z": z, "w": w})
            assert values == pytest.approx(tuple(numbers(row[2])), abs=4 * DIGITS), row[0]


def test_the_bytes_of_the_example_match_the_rows():
    x, y, z, _ = Q
    row = ICD.telemetry["quaternion"].encode({"q_x": x, "q_y": y, "q_z": z})
    assert row.hex(" ").upper() == EXAMPLE["`quaternion` (230), its 6 bytes"]
    sent = bytes.fromhex(EXAMPLE["`precise_attitude` (160), bytes 12 to 27"])
    assert struct.unpack("<4f", sent) == pytest.approx(tuple(Q), abs=DIGITS)
    fields = ICD.telemetry["precise_attitude"].named_fields
    assert (fields["q_x"].offset, fields["q_w"].offset + 3) == (12, 27)


def test_other_programs_have_the_conjugate():
    for program in ("attitude matrix A(q) of a textbook", "42"):
        assert textbook(numbers(OTHERS[program])) == pytest.approx(MATRIX, abs=4 * DIGITS)
    assert numbers(OTHERS["SciPy"]) == pytest.approx(Q)


def test_basilisk_parameters_become_the_quaternion():
    sigma = numbers(OTHERS["Basilisk"])
    square = sigma @ sigma
    assert np.append(-2.0 * sigma, 1.0 - square) / (1.0 + square) == pytest.approx(Q, abs=4 * DIGITS)
    tilde = np.cross(np.eye(3), sigma)
    assert tilde @ [1.0, 2.0, 3.0] == pytest.approx(np.cross(sigma, [1.0, 2.0, 3.0]))
    bn = np.eye(3) + (8.0 * tilde @ tilde - 4.0 * (1.0 - square) * tilde) / (1.0 + square) ** 2
    assert bn == pytest.approx(MATRIX, abs=8 * DIGITS)  # MRP2C of Basilisk's RigidBodyKinematics


def test_a_matrix_becomes_the_quaternion():
    c = MATRIX
    w = np.sqrt(1.0 + np.trace(c)) / 2.0
    vector = np.array([c[2, 1] - c[1, 2], c[0, 2] - c[2, 0], c[1, 0] - c[0, 1]]) / (4.0 * w)
    assert np.append(vector, w) == pytest.approx(Q, abs=4 * DIGITS)


@pytest.mark.parametrize("name", ["markdown", "html"])
def test_human_readable_exports_contain_the_convention(name):
    document = export(ICD, name)
    for section in ICD.sections:
        assert section.heading in document
        for cell in (cell for row in section.rows for cell in row if re.fullmatch(r"[-0-9., ]+", cell)):
            assert cell in document


def test_an_unknown_key_hides_what_it_may_cause(tmp_path):
    (tmp_path / "a.toml").write_text(
        'unit = { name = "x", version = "1", doc = "x" }\n'
        '[[section]]\nheading = "Frames"\ncolums = 1\ncolumns = ["a", "b"]\nrows = [["1", "2"], ["3"]]\n'
    )
    assert examine(tmp_path)[1] == [
        f"{tmp_path}/a.toml: section.Frames.colums: unknown key; did you mean columns?"
    ]


def test_a_row_of_a_section_has_a_cell_a_column(tmp_path):
    (tmp_path / "a.toml").write_text(
        'unit = { name = "x", version = "1", doc = "x" }\n'
        '[[section]]\nheading = "Frames"\ncolumns = ["a", "b"]\nrows = [["1", "2"], ["3"]]\n'
    )
    with pytest.raises(IcdError, match=r"section\.Frames: row 2 has 1 cells, must have 2"):
        load_unit(tmp_path)


def test_errors_speak_of_lists_as_toml_does(tmp_path):
    (tmp_path / "a.toml").write_text(
        'unit = { name = "x", version = "1", doc = "x" }\n'
        'conventions = { axes = ["+x", "+y"] }\n'
        '[[section]]\nheading = "Frames"\ncolumns = "a"\nrows = []\n'
    )
    axes, columns = examine(tmp_path)[1]
    assert axes.endswith("conventions.axes: must have at least 3 items, not 2")
    assert columns.endswith("section.Frames.columns: must be a list (given: 'a')")
