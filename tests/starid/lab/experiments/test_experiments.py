"""Running experiments: parts, resuming, checks, report, command line; numbers printed in the thesis."""

import csv
import dataclasses
import json
import zipfile
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from starid.cli.app import build_app
from starid.errors import StaridError
from starid.identification.thesis.frame_grid import make_grid
from starid.lab.experiments import figures, registry, report, runner, tables
from starid.lab.experiments.comparison import (
    Outcome,
    Published,
    Row,
    claimed,
    compared,
    null_model,
)
from starid.lab.experiments.experiment import (
    Context,
    Evaluation,
    Experiment,
    Parameters,
    Part,
    Results,
    parts_of,
    write_csv,
)
from starid.lab.experiments.lsi_trials import (
    FRAMES,
    OFF,
    ON,
    centres,
    frames_under_test,
)
from starid.lab.experiments.tables import (
    CHOICES,
    KNOWN_MISSES,
    PUBLISHED,
    KnownMiss,
    class_of,
    known_miss,
    numbers_by_choice,
)

pytestmark = pytest.mark.long

TIME_COLUMN = 6


def _parts(parameters: Parameters) -> list[Part]:
    return [Part(f"part{i}", {"number": i}) for i in parameters["numbers"]]


def _compute(context: Context, part: Part) -> Results:
    calls = context.folder.parent / "calls.txt"
    calls.parent.mkdir(parents=True, exist_ok=True)
    with calls.open("a") as stream:
        stream.write(f"{context.name} {part.key}\n")
    return {"value": context.rng(part.key).normal(size=3) + part.values["number"]}


def _evaluate(e: Evaluation) -> None:
    sums = {key: result["value"].sum() for key, result in e.results.items()}
    e.write("values.csv", {"key": list(sums), "sum": list(sums.values())})
    total = float(sum(sums.values()))
    e.compare("total | of all", text=1.0, ours=total, check=f"≥ {e.parameters['least']}")


def _experiment(name: str = "toy", least: float = -1e9) -> Experiment:
    return Experiment(
        name,
        "A toy",
        _parts,
        _compute,
        _evaluate,
        full={"numbers": [1, 2, 3], "least": least},
        quick={"numbers": [1], "least": least},
    )


def _calls(folder: Path) -> list[str]:
    path = folder / "calls.txt"
    return path.read_text().splitlines() if path.exists() else []


def test_a_finished_experiment_is_not_run_again(tmp_path):
    first = runner.run([_experiment()], tmp_path, jobs=1)
    assert len(_calls(tmp_path)) == 3
    again = runner.run([_experiment()], tmp_path, jobs=1)
    assert len(_calls(tmp_path)) == 3
    assert again[0].parts == 0
    assert again[0].outcome == first[0].outcome


def test_experiments_start_by_turn_and_are_reported_in_order(tmp_path):
    late, early = _experiment("late"), dataclasses.replace(_experiment("early"), start_order=0)
    ended = runner.run([late, early], tmp_path, quick=True, jobs=1)
    assert _calls(tmp_path) == ["early part1", "late part1"]
    assert [result.experiment.name for result in ended] == ["late", "early"]


def test_only_changed_parts_are_computed_again(tmp_path):
    runner.run([_experiment()], tmp_path, jobs=1)
    longer = dataclasses.replace(_experiment(), full={"numbers": [1, 2, 3, 4], "least": -1e9})
    assert runner.run([longer], tmp_path, jobs=1)[0].parts == 1
    revised = dataclasses.replace(longer, revision=2)
    assert runner.run([revised], tmp_path, jobs=1)[0].parts == 4
    assert runner.run([revised], tmp_path, seed=2, jobs=1)[0].parts == 4


def test_a_run_resumes_where_it_was_interrupted(tmp_path):
    whole = runner.run([_experiment()], tmp_path / "whole", jobs=1)[0].outcome

    def interrupted(context: Context, part: Part) -> Results:
        if part.key == "part3":
            raise KeyboardInterrupt
        return _compute(context, part)

    with pytest.raises(KeyboardInterrupt):
        runner.run([dataclasses.replace(_experiment(), compute=interrupted)], tmp_path / "cut", jobs=1)
    assert len(_calls(tmp_path / "cut")) == 2
    resumed = runner.run([_experiment()], tmp_path / "cut", jobs=1)[0]
    assert (resumed.parts, resumed.outcome) == (1, whole)


def test_a_missing_output_file_is_made_again_from_the_parts(tmp_path):
    runner.run([_experiment()], tmp_path, jobs=1)
    (tmp_path / "toy" / "values.csv").unlink()
    assert runner.run([_experiment()], tmp_path, jobs=1)[0].parts == 0
    assert (tmp_path / "toy" / "values.csv").exists()
    assert len(_calls(tmp_path)) == 3


def test_a_damaged_part_is_rejected_by_name(tmp_path):
    runner.run([_experiment()], tmp_path, jobs=1)
    part = next((tmp_path / "toy" / "parts").glob("part2-*.npz"))
    part.write_bytes(part.read_bytes()[:40])
    (tmp_path / "toy" / "outcome.json").unlink()
    with pytest.raises(StaridError, match=r"part2.*remove it"):
        runner.run([_experiment()], tmp_path, jobs=1)


def test_a_part_with_damaged_contents_is_rejected_by_name(tmp_path):
    runner.run([_experiment()], tmp_path, jobs=1)
    part = next((tmp_path / "toy" / "parts").glob("part2-*.npz"))
    content = bytearray(part.read_bytes())
    with zipfile.ZipFile(part) as archive:
        start = archive.getinfo("value.npy").header_offset
    names = int.from_bytes(content[start + 26 : start + 28], "little")
    extra = int.from_bytes(content[start + 28 : start + 30], "little")
    content[start + 30 + names + extra] = 0xFF  # a block type that does not exist in deflate
    part.write_bytes(content)
    (tmp_path / "toy" / "outcome.json").unlink()
    with pytest.raises(StaridError, match=r"part2.*invalid block type.*remove it"):
        runner.run([_experiment()], tmp_path, jobs=1)


def test_an_interrupted_evaluation_leaves_no_outcome_of_other_parameters(tmp_path):
    runner.run([_experiment()], tmp_path, jobs=1)
    values = (tmp_path / "toy" / "values.csv").read_text()

    def interrupted(evaluation: Evaluation) -> None:
        _evaluate(evaluation)
        raise KeyboardInterrupt

    longer = dataclasses.replace(
        _experiment(), full={"numbers": [1, 2, 3, 4], "least": -1e9}, evaluate=interrupted
    )
    with pytest.raises(KeyboardInterrupt):
        runner.run([longer], tmp_path, jobs=1)
    runner.run([_experiment()], tmp_path, jobs=1)
    assert (tmp_path / "toy" / "values.csv").read_text() == values


def test_parts_on_the_sphere_do_not_depend_on_the_process_s_history(tmp_path):
    spherical = registry.experiments()["spherical"]
    parameters = {**spherical.full, "frames": 2}
    context = Context(tmp_path, tmp_path, "spherical", 1, parameters, quick=False)
    parts = {part.key: part for part in spherical.parts(parameters)}

    def numbers(key: str) -> np.ndarray:
        return np.delete(spherical.compute(context, parts[key])["numbers"], TIME_COLUMN, axis=1)

    first = numbers("lsi-1")
    numbers("lsi-2")
    np.testing.assert_array_equal(numbers("lsi-1"), first)


def test_results_do_not_depend_on_the_number_of_processes(tmp_path):
    one = runner.run([_experiment()], tmp_path / "one", jobs=1)[0].outcome
    two = runner.run([_experiment()], tmp_path / "two", jobs=2)[0].outcome
    assert one == two


def test_progress_counts_up_to_all_parts(tmp_path):
    progress: list[tuple[str, int, int]] = []
    runner.run(
        [_experiment(), dataclasses.replace(_experiment("other"), alone=True)],
        tmp_path,
        jobs=1,
        progress=lambda *step: progress.append(step),
    )
    assert [(done, total) for _, done, total in progress] == [(i, 6) for i in range(1, 7)]
    assert [name for name, _, _ in progress[3:]] == ["other"] * 3


@pytest.mark.parametrize(
    ("ours", "check", "passed", "target"),
    [
        (99.95, "≥ 99.9", True, "≥ 99.9 %"),
        (99.89, "≥ 99.9", False, "≥ 99.9 %"),
        (0.5, "≤ 0.5", True, "≤ 0.5 %"),
        (0.6, "≤ 0.5", False, "≤ 0.5 %"),
        (float("nan"), "≥ 0", False, "≥ 0 %"),
        (1.0, "", None, ""),
    ],
)
def test_a_bound_makes_a_row_a_check_of_our_own(ours, check, passed, target):
    made = compared("q", Published("", "%", check=check), ours=ours)
    assert (made.passed, made.target, made.kind) == (passed, target, "ours" if check else "")


@pytest.mark.parametrize(
    ("published", "value", "passed"),
    [
        (71.43, 71.43, True),
        (71.43, 72.9, True),
        (71.43, 69.9, False),
        (71.43, 73.0, False),
        (1.0, float("nan"), False),
    ],
)
def test_agreement_is_two_sided(published, value, passed):
    made = compared("q", Published(str(published), check="1.5 1.5 points"), author=value, printed=0.0)
    assert (made.passed, made.kind, made.met, made.of) == (passed, "agrees", int(passed), 1)
    assert made.target == "± 1.5 points"


@pytest.mark.parametrize(
    ("values", "passed"),
    [
        ({"author": 1.0, "printed": 9.0, "ours": 9.0}, True),
        ({"author": 9.0, "printed": 1.0, "ours": 1.0}, False),
        ({"printed": 1.0, "ours": 9.0}, True),
        ({"ours": 9.0}, False),
    ],
)
def test_the_value_closest_to_the_author_s_version_is_compared(values, passed):
    assert compared("q", Published("1", check="0.1 a tenth"), **values).passed is passed


def test_an_agreement_needs_a_number():
    with pytest.raises(StaridError, match="no number to compare"):
        compared("q", Published("1", check="0.1 a tenth"), ours="many")


@pytest.mark.parametrize(
    ("larger", "ours", "passed", "words"),
    [
        (True, 99.0, True, "by 9.00"),
        (True, 89.0, False, ""),
        (False, 80.0, True, "by 10.00"),
        (False, 0.9, True, "by a factor of 100"),
        (False, 91.0, False, ""),
    ],
)
def test_an_improvement_is_one_sided_and_quantified(larger, ours, passed, words):
    made = compared("q", Published("90", check="more" if larger else "less"), ours=ours)
    assert (made.passed, made.kind) == (passed, "better")
    assert words in made.remark


def test_a_row_of_several_numbers_counts_each():
    made = claimed("q", published="1, 2, 3", author="1, 2, 4", matches=[True, True, False], target="the same")
    assert (made.passed, made.met, made.of) == (False, 2, 3)
    assert "2 of 3 agree" in made.remark


def test_the_best_constant_marks_the_checks_that_it_meets():
    rows = [
        compared(f"q{x}", Published(str(x), check="0.6"), author=value)
        for x, value in ((98.0, 98.0), (100.0, 5.0), (100.5, 100.5), (90.0, 90.0))
    ]
    marked = null_model(rows)
    assert [(row.weak, row.weak_met) for row in marked] == [(0, 0), (1, 0), (1, 1), (0, 0)]
    found = report.counts([_finished(tuple(marked))])
    assert found["weak"] == {"met": 1, "of": 2}
    assert found["agrees"] == {"met": 2, "of": 2}


def test_numbers_that_a_null_model_meets_are_counted_apart():
    made = claimed("q", published="", matches=[True, True, False], null=[True, False, True], target="")
    found = report.counts([_finished((made,))])
    assert found["weak"] == {"met": 1, "of": 2}
    assert found["agrees"] == {"met": 1, "of": 1}


def test_the_sampling_error_combines_two_counts():
    low, high = compared("q", Published("50", check="sampling 1000"), ours=50.0).interval
    assert 0.5 * (high - low) == pytest.approx(3.0 * np.sqrt(2.0 * 0.25 / 1000.0) * 100.0, rel=1e-2)
    low, high = compared("q", Published("100", check="sampling 1000"), ours=50.0).interval
    assert 0.0 < high - low < 2.0


def test_columns_of_unequal_length_are_rejected(tmp_path):
    with pytest.raises(StaridError, match=r"t\.csv have the lengths \[1, 2\]"):
        write_csv(tmp_path / "t.csv", {"a": [1], "b": [1, 2]})


def test_the_report_lists_failed_checks_and_links_the_files(tmp_path):
    results = runner.run([_experiment(least=1e9)], tmp_path, jobs=1)
    text = report.report_text(results, quick=False, seed=1)
    assert "| bounds of this project hold | 0 | 1 |" in text
    assert "## Regressions" in text
    assert "total \\| of all" in text
    assert "[values.csv](toy/values.csv)" in text
    assert report.summary(results)["missed"] == 1


def test_a_known_miss_is_shown_with_its_reason_and_is_not_a_regression(tmp_path, monkeypatch):
    known = {("toy", "total | of all"): KnownMiss("The sky has no such total.")}
    monkeypatch.setattr(tables, "KNOWN_MISSES", known)
    results = runner.run([_experiment(least=1e9)], tmp_path, jobs=1)
    text = report.report_text(results, quick=False, seed=1)
    assert "## Known misses" in text
    assert "## Regressions" not in text
    assert "The sky has no such total." in text
    assert report.summary(results)["regressions"] == []
    assert report.counts(results)["ours"] == {"met": 0, "of": 1}


def test_a_row_that_agrees_less_than_known_is_a_regression(monkeypatch):
    monkeypatch.setitem(tables.KNOWN_MISSES, ("toy", "q"), KnownMiss("Two of them are not known.", 2))
    for met, regression in ((2, False), (3, False), (1, True)):
        made = claimed("q", published="", matches=[True] * met + [False] * (4 - met), target="")
        assert (known_miss("toy", made) is None) is regression


def test_every_known_miss_has_a_reason_and_an_experiment():
    names = set(registry.experiments())
    for (experiment, quantity), entry in KNOWN_MISSES.items():
        assert experiment in names
        assert entry.reason.endswith("."), quantity


def _finished(rows):
    return runner.FinishedExperiment(_experiment(), Outcome(rows), seconds=0.0, parts=0)


def _invoke(*arguments: str):
    return CliRunner().invoke(build_app(["reproduce"]), ["reproduce", *arguments])


@pytest.mark.parametrize(("least", "known", "status"), [(-1e9, False, 0), (1e9, False, 1), (1e9, True, 0)])
def test_the_exit_status_reports_a_regression(tmp_path, monkeypatch, least, known, status):
    monkeypatch.setattr(registry, "experiments", lambda: {"toy": _experiment(least=least)})
    entries = {("toy", "total | of all"): KnownMiss("Known.")} if known else {}
    monkeypatch.setattr(tables, "KNOWN_MISSES", entries)
    result = _invoke("toy", "-o", str(tmp_path), "--jobs", "1", "--json")
    assert result.exit_code == status, result.output
    figures = json.loads(result.stdout)
    assert figures["missed"] == int(least > 0)
    assert len(figures["regressions"]) == status
    assert Path(figures["report"]).read_text().startswith("# The thesis's experiments")


def test_the_report_holds_all_that_is_finished_in_the_folder(tmp_path, monkeypatch):
    known = {"toy": _experiment(), "other": _experiment("other")}
    monkeypatch.setattr(registry, "experiments", lambda: known)
    _invoke("toy", "-o", str(tmp_path), "--jobs", "1")
    _invoke("other", "-o", str(tmp_path), "--jobs", "1")
    text = (tmp_path / "report.md").read_text()
    assert "`toy`" in text
    assert "`other`" in text


def test_an_unknown_experiment_is_rejected_with_the_nearest_name():
    with pytest.raises(StaridError, match="no experiment lsi-acuracy; did you mean lsi-accuracy"):
        registry.select(["lsi-acuracy"], quick=False)


def test_an_experiment_without_a_quick_form_is_skipped_or_rejected(monkeypatch):
    known = {"toy": _experiment(), "slow": dataclasses.replace(_experiment("slow"), quick=None)}
    monkeypatch.setattr(registry, "experiments", lambda: known)
    assert [experiment.name for experiment in registry.select([], quick=True)] == ["toy"]
    with pytest.raises(StaridError, match="slow has no quick form"):
        registry.select(["slow"], quick=True)


def test_parts_of_all_experiments_have_valid_file_names():
    for experiment in registry.experiments().values():
        for parameters in (experiment.full, experiment.quick):
            if parameters is not None:
                keys = [part.key for part in experiment.parts(parameters)]
                assert keys
                assert len(set(keys)) == len(keys)
                assert not any(set(key) & set("/\\ :*") for key in keys), experiment.name
                json.dumps(dict(parameters))


def test_all_test_frames_are_on_the_grid_and_moved_ones_are_not():
    grid = make_grid("planar", 40.0, 0.995)
    assert len(centres()) == FRAMES == 1701
    for kind, most in ((ON, 1e-9), (OFF, None)):
        frames = frames_under_test(np.random.default_rng(3), kind, grid.step_deg, 1)
        steps = np.stack(
            [
                (frames[:, 0] - grid.first_ra_deg) / grid.step_deg,
                (frames[:, 1] - grid.row_dec_deg[0]) / grid.step_deg,
            ]
        )
        away = np.abs(steps - np.rint(steps))
        if most is not None:
            assert away.max() < most
        else:
            assert away.min() > 1e-6
            assert 0.2 < away.mean() < 0.3


def test_the_quick_run_of_the_accuracy_evaluates_fewer_frames(tmp_path, monkeypatch):
    def without_pixels(figure, path):
        figure.clear()
        path.touch()
        return path.name

    monkeypatch.setattr(figures, "save", without_pixels)
    accuracy = registry.experiments()["lsi-accuracy"]
    context = Context(tmp_path, tmp_path, "lsi-accuracy", 1, accuracy.quick, quick=True)
    parts, results, rng = accuracy.parts(accuracy.quick), {}, np.random.default_rng(1)
    for part in parts:
        frames = centres(1 if part.values["percent"] == 99.5 else accuracy.quick["every"])
        kinds = ("author_mse", "author_1se", "mse", "1se", "fine", "stars")
        names = [f"{quantity}_{kind}" for quantity in ("f", "theta") for kind in kinds]
        errors = {
            name: rng.uniform(0.0, 1.0, len(frames)) for name in (*names, "psi_mse", "psi_author", "residual")
        }
        results[part.key] = {"frames": frames, **errors}
    evaluation = Evaluation(context, parts, results)
    accuracy.evaluate(evaluation)
    files = set(evaluation.outcome().files)
    assert {"figure_6_1_on.png", "figure_6_4.csv", "errors_p99.5-off.csv"} <= files
    assert "figure_6_3_on.png" not in files


def test_the_worked_example_agrees_with_the_thesis(tmp_path):
    example = registry.experiments()["worked-example"]
    outcome = runner.run([example], tmp_path, quick=True, jobs=1)[0].outcome
    missed = {entry.quantity for entry in outcome.failed}
    # the λ chosen by cross-validation with random folds is not on the grid of eq. 2.34
    assert all("reconstruct" in quantity or quantity == "ω (MSE) of the nine cells" for quantity in missed)
    agreeing = [entry for entry in outcome.rows if entry.kind == "agrees"]
    assert (sum(entry.met for entry in agreeing), sum(entry.of for entry in agreeing)) == (104, 113)
    weights = {entry.quantity: entry.met for entry in agreeing if entry.quantity.startswith("ω")}
    assert weights == {"ω (MSE) of the nine cells": 8, "ω (1SE) of the nine cells": 9}
    with (tmp_path / "worked-example" / "dictionary.csv").open() as stream:
        table = list(csv.DictReader(stream))
    assert [int(line["cell"]) for line in table] == [509, 510, 511, 734, 735, 736, 959, 960, 961]
    assert (tmp_path / "worked-example" / "figure_5_1.png").read_bytes().startswith(b"\x89PNG")


def test_the_sizes_of_the_databases_are_the_published_ones(tmp_path):
    sizes = registry.experiments()["database-sizes"]
    outcome = runner.run([sizes], tmp_path, quick=True, jobs=1)[0].outcome
    assert {entry.quantity for entry in outcome.failed} == {
        "table 6.1: database size, p = 98 %",
        "table 6.1: database size, p = 99.3 %",
        "nominal N, eq. 2.23, φ = 42°, p = 99.5 %",
    }
    assert sum(entry.passed is True for entry in outcome.rows) >= 18


def test_the_experiments_of_the_thesis_need_nothing_else_of_the_emulator():
    folder = Path(registry.__file__).parent
    for module in folder.glob("*.py"):
        for line in module.read_text(encoding="utf-8").splitlines():
            if line.strip().startswith(("from emulator", "import emulator")):
                assert "starid.lab.experiments" in line, f"{module.name}: {line}"


@pytest.mark.parametrize(
    ("known", "values", "passed", "target"),
    [
        (Published("0.1", "°", 3, "0.05 half of it"), {"author": 0.14}, True, "± half of it"),
        (Published("99.5", "%", 1, "rounding 0"), {"printed": 99.9}, True, "± half of the last digit, 0.5 %"),
        (Published("0.49", check="mean 0.5 200"), {"author": 0.6}, True, "of two means of 200, 0.15"),
        (Published("0.49", check="mean 0.5 200"), {"author": 0.65}, False, "of two means of 200, 0.15"),
        (
            Published("0.5", check="deviation 0.5 101"),
            {"author": 0.66},
            False,
            "of two deviations of 101, 0.15",
        ),
        (
            Published("0.9", check="coefficient 203"),
            {"author": 0.86},
            True,
            "of two coefficients of 203, 0.057",
        ),
        (
            Published("0.9", check="coefficient 203"),
            {"author": 0.84},
            False,
            "of two coefficients of 203, 0.057",
        ),
        (Published("50", "%", 1, "sampling"), {"ours": 45.0, "trials": 1000}, True, "two shares of 1000"),
        (Published("1 2", digits=0, check="same"), {"printed": [1, 2]}, True, "the same"),
        (Published("1 2", digits=1, check="digit"), {"printed": [1.04, 2.06]}, False, "each ± half"),
        (Published("below a fifth", "%", 1, "< 20"), {"author": 19.0}, True, "< 20 %"),
        (Published("positive", check="> 0"), {"author": -0.1, "printed": 1.0}, False, "> 0"),
        (Published("2", check="less"), {"ours": 1.0}, True, "≤ 2"),
        (Published("2", check="more"), {"ours": 1.0}, False, "≥ 2"),
        (Published("about 2"), {"ours": 9.0}, None, ""),
        (Published("2"), {"ours": 9.0}, None, ""),
        (
            Published("1e-14", check="deviation 1e-14 10"),
            {"author": 9e-13},
            True,
            "of two deviations of 10, 1e-12",
        ),
    ],
)
def test_a_quantity_is_checked_as_its_line_says(known, values, passed, target):
    made = compared("q", known, **values)
    assert made.passed is passed
    assert target in made.target
    assert (made.of > 0) is (passed is not None)


def test_every_published_line_has_its_place_in_the_thesis_and_a_check_that_can_be_made():
    names = set(registry.experiments())
    lines = tables.read_lines("published.csv")
    assert len(lines) == len(PUBLISHED)
    for line in lines + tables.read_lines("columns.csv"):
        assert line["source"].startswith(("section ", "table", "figure", "eq. ")), line
    for (experiment, quantity), published in PUBLISHED.items():
        assert experiment in names
        if published.check:
            values = published.numbers or [1.0]
            value = values if published.check == "same" or len(values) > 1 else values[0]
            key = "ours" if published.check in ("more", "less") else "author"
            assert compared(quantity, published, **{key: value}, trials=100).of == len(values)


def test_parts_are_the_combinations_of_lists_values_and_parameters():
    parameters = {
        "percent": [1, 2],
        "trials": [{"key": "{kind}-p{percent}", "kind": ["a", "b"], "percent": "percent"}],
    }
    assert [part.key for part in parts_of(parameters)] == ["a-p1", "a-p2", "b-p1", "b-p2"]
    assert parts_of({"trials": [{"key": "x", "word": "one"}]}) == [Part("x", {"word": "one"})]


def test_a_line_of_a_large_table_is_checked_as_its_columns_say(tmp_path):
    evaluation = Evaluation(Context(tmp_path, tmp_path, "toy", 1, {}, quick=False), [], {})
    known = {"trigger_percent": 15.1, "exceeded_percent": 35.1}
    measured = {"trigger_percent": 15.0, "exceeded_percent": {"printed": 90.0, "remark": "Far off."}}
    evaluation.compare_line("6.7", "0.995", "table 6.7, first", known, measured)
    near, far = evaluation.outcome().rows
    assert (near.quantity, near.author, near.passed) == ("table 6.7, first: triggers", "15.0 %", True)
    assert (far.printed, far.passed, far.remark) == ("90.0 %", False, "Far off.")
    assert "two shares of 1001" in far.target


def test_a_full_run_must_compare_every_published_number(tmp_path):
    contexts = [Context(tmp_path, tmp_path, "rsi", 1, {}, quick=quick) for quick in (True, False)]
    quick, full = (Evaluation(context, [], {}) for context in contexts)
    assert quick.outcome().rows == ()
    with pytest.raises(StaridError, match=r"rsi does not compare greatest mean ε_f of all sets, p = 99\.5 %"):
        full.outcome()


def test_rows_of_a_column_are_reported_together_and_its_constant_is_weak(tmp_path):
    evaluation = Evaluation(Context(tmp_path, tmp_path, "toy", 1, {}, quick=False), [], {})
    for number in (1.0, 2.0):
        for column in ("a", "b"):
            text = 5.0 if column == "a" else number
            evaluation.compare(
                f"{column}{number:g}", text=text, check="0.1 tenth", column=column, author=text
            )
    rows = evaluation.outcome().rows
    assert [(made.quantity, made.weak) for made in rows] == [("a1", 1), ("a2", 1), ("b1", 1), ("b2", 0)]


def _rate(quantity: str, published: float) -> Row:
    return compared(quantity, Published(str(published), check="0.1 a tenth"), author=99.9)


def test_a_number_to_which_a_constant_was_fitted_is_no_agreement():
    fitted, predicted = (
        "position and brightness noise, σ = 1, on the grid: share",
        "position noise, σ = 3, on the grid",
    )
    assert class_of("lsi-noise", _rate(fitted, 99.9)) == "fitted"
    assert class_of("lsi-noise", _rate(predicted, 99.9)) == "agrees"
    assert class_of("lsi-accuracy", _rate(fitted, 99.9)) == "agrees"
    rows = [("lsi-noise", _rate(fitted, 99.9)), ("lsi-noise", _rate(predicted, 50.0))]
    assert numbers_by_choice(rows)["noise of 0.27·√σ"] == {"numbers": 2, "agree": 1, "fitted": 1}


def test_a_number_without_the_authors_version_depends_on_no_choice():
    printed = compared("position and brightness noise", Published("1", check="0.1 a tenth"), printed=1.0)
    assert class_of("lsi-noise", printed) == "agrees"


def test_every_choice_names_an_experiment_and_every_quick_fitted_number_is_counted_apart(tmp_path):
    assert {each.experiment for each in CHOICES} <= set(registry.experiments())
    results = runner.run([registry.experiments()["worked-example"]], tmp_path, quick=True, jobs=1)
    counts = report.counts(results)
    assert counts["fitted"] == {"met": 17, "of": 18}
    assert counts["agrees"] == {"met": 87, "of": 95}
    text = report.report_text(results, quick=True, seed=1)
    assert "| λ = 1.00 | 19 | 15 | 9 |" in text
    assert "| 17 | 18 |" in text
