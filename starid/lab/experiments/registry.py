"""Registry of the experiments: the entries of `experiments.toml` with the functions of their modules."""

from __future__ import annotations

import difflib
import importlib
import tomllib
from collections.abc import Sequence
from pathlib import Path

from starid.lab.experiments.comparison import ReproduceError
from starid.lab.experiments.experiment import Experiment, parts_of

_FILE = Path(__file__).with_name("experiments.toml")


def experiments() -> dict[str, Experiment]:
    """All experiments by name, in the order of the thesis.

    An entry names a module of this package and, if it holds several experiments, the end of the names of its
    functions: `compute`, `evaluate` and, instead of the trials in the entry, `parts`. The quick run has the
    parameters of the full one but for those in `quick`; without that table there is none.
    """
    experiments_by_name = {}
    for name, entry in tomllib.loads(_FILE.read_text(encoding="utf-8")).items():
        module_name, _, end = entry.pop("module").partition(":")
        functions = vars(importlib.import_module(f"starid.lab.experiments.{module_name}"))
        compute, evaluate = (functions[f"{word}_{end}" if end else word] for word in ("compute", "evaluate"))
        full, quick = entry.pop("full"), entry.pop("quick", None)
        experiments_by_name[name] = Experiment(
            name,
            parts=functions.get("parts", parts_of),
            compute=compute,
            evaluate=evaluate,
            full=full,
            quick=None if quick is None else full | quick,
            **entry,
        )
    return experiments_by_name


def select(names: Sequence[str], *, quick: bool) -> list[Experiment]:
    """Select experiments by name; without names all of them, or all that have a quick form.

    Raises
    ------
    ReproduceError
        A name is unknown, or has no quick form although the quick run is requested.
    """
    by_name = experiments()
    if not names:
        return [experiment for experiment in by_name.values() if not quick or experiment.quick is not None]
    for name in names:
        if name not in by_name:
            near = difflib.get_close_matches(name, by_name, n=1)
            hint = f"did you mean {near[0]}?" if near else "`starid reproduce --list` lists them all"
            raise ReproduceError(f"reproduce: there is no experiment {name}; {hint}")
        by_name[name].parameters(quick=quick)
    return [by_name[name] for name in dict.fromkeys(names)]
