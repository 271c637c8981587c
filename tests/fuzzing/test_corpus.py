"""The inputs that fuzzing has kept, and the seeds of each target, meet no error that is not documented."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.fuzzing.targets import CORPUS, TARGETS, read_corpus

pytestmark = pytest.mark.long


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.process] * (name == "http")) for name in TARGETS]
)
def test_no_kept_input_fails(name: str, tmp_path: Path) -> None:
    run = TARGETS[name].runner(tmp_path)
    for data in [*TARGETS[name].seeds(), *read_corpus(name)]:
        run(data)


def test_every_corpus_belongs_to_a_target_and_is_small() -> None:
    assert {path.stem for path in CORPUS.iterdir()} <= TARGETS.keys()
    assert max(path.stat().st_size for path in CORPUS.iterdir()) <= 3000
