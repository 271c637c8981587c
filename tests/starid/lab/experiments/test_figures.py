"""Figures from tables: how lines become curves, and curves panels."""

from __future__ import annotations

import numpy as np
import pytest

from starid.lab.experiments.figures import Curve, Panel, curves_of, draw, panels_of, precision

pytestmark = pytest.mark.long


def test_lines_of_a_table_become_a_curve_for_each_label():
    table = [{"x": x, "y": 10 * x + k, "case": f"k = {k}"} for k in (1, 2) for x in (0, 1, 2)]
    first, second = curves_of(table, "x", "y", lambda line: line["case"])
    assert (first.label, first.x, first.y) == ("k = 1", [0, 1, 2], [1, 11, 21])
    assert (second.label, second.y) == ("k = 2", [2, 12, 22])


def test_curves_of_one_title_share_a_panel_in_order():
    curves = [("b", Curve([0], [1], "-", "one")), ("a", Curve([0], [2])), ("b", Curve([0], [3]))]
    made = panels_of([*curves, Panel("a", [])])
    assert [(panel.title, [curve.y for curve in panel.curves]) for panel in made] == [
        ("b", [[1], [3]]),
        ("a", [[2]]),
        ("a", []),
    ]


def test_precision_is_the_share_of_errors_up_to_a_threshold():
    curve = precision(np.array([0.1, 0.3, 2.0, np.nan]), 1.0)
    rate = dict(zip(curve.x.tolist(), curve.y.tolist(), strict=True))
    assert [rate[limit] for limit in (0.0, 0.1, 0.299, 0.3, 1.0)] == [0.0, 25.0, 25.0, 50.0, 50.0]


def test_a_figure_with_empty_places_is_drawn(tmp_path):
    made = ((f"panel {i}", Curve([0, 1], [0, i], label="line")) for i in range(3))
    assert draw(tmp_path / "three.png", made, columns=2, legend="best", axes={"xlabel": "x"}) == "three.png"
    assert (tmp_path / "three.png").read_bytes().startswith(b"\x89PNG")
