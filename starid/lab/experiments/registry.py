"""Registry of the experiments."""

from __future__ import annotations

import difflib
import importlib
from collections.abc import Sequence
from typing import Final

from starid.lab.experiments.experiment import Experiment, ReproduceError

MODULES: Final[tuple[str, ...]] = (
    "feature_maps",
    "database_sizes",
    "worked_example",
    "lsi_accuracy",
    "lsi_noise",
    "lsi_run_time",
    "missing_stars",
    "sensitivity",
    "memory",
    "filter_example",
    "fsf",
    "fsf_studies",
    "rsi",
    "rsi_printed",
    "spherical",
    "classics",
)
"""Modules of this package that export `EXPERIMENTS`, in the order of the thesis."""


def experiments() -> dict[str, Experiment]:
    """All experiments by name, in the order of the thesis.

    Raises
    ------
    ReproduceError
        Two modules use the same name.
    """
    found: dict[str, Experiment] = {}
    for module in MODULES:
        for experiment in importlib.import_module(f"starid.lab.experiments.{module}").EXPERIMENTS:
            if experiment.name in found:
                raise ReproduceError(f"reproduce: two experiments are called {experiment.name}")
            found[experiment.name] = experiment
    return found


def select(names: Sequence[str], *, quick: bool) -> list[Experiment]:
    """Select experiments by name; without names all of them, or all that have a quick form.

    Raises
    ------
    ReproduceError
        A name is unknown, or has no quick form although the quick run is requested.
    """
    known = experiments()
    if not names:
        return [experiment for experiment in known.values() if not quick or experiment.quick is not None]
    for name in names:
        if name not in known:
            near = difflib.get_close_matches(name, known, n=1)
            hint = f"did you mean {near[0]}?" if near else "`starid reproduce --list` lists them all"
            raise ReproduceError(f"reproduce: there is no experiment {name}; {hint}")
        if quick and known[name].quick is None:
            raise ReproduceError(f"reproduce: {name} has no quick form; run it without --quick")
    return [known[name] for name in dict.fromkeys(names)]
