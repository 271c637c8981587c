"""Plant each defect of tests/hil_tests/endurance/mutants.toml in the running product and let endurance runs find it.

python tools/endurance_mutants.py [--minutes 10] [--only WORDS]

Each defect has a process of its own. Prints the processor time and the violation with which each was found. The exit status is 1
if one was not found.
"""

from __future__ import annotations

import argparse
import itertools
import logging
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

ROOT = Path(__file__).parent.parent
sys.path.insert(0, str(ROOT))

from starhil.emulator.cli.endurance import run_once  # noqa: E402
from starhil.emulator.launch.unit_in_memory import links_of  # noqa: E402
from starhil.hil_tests.endurance.life import make_life  # noqa: E402
from starhil.hil_tests.judge.definition import unit_of  # noqa: E402
from starhil.protocol.files.bundled import bundled_units  # noqa: E402
from starhil.protocol.unit import load_unit  # noqa: E402
from tests.planted import PlantedDefect, read_defects  # noqa: E402

MUTANTS = read_defects(ROOT / "tests/hil_tests/endurance/mutants.toml", PlantedDefect)
STEPS = 400


def find(mutant: PlantedDefect, minutes: float) -> str:
    """Return the processor time and the violation with which a defect was found, empty if it was not.

    Lives the lives of one seed after the other, of all units in turns.
    """
    logging.getLogger("starhil").addHandler(logging.NullHandler())
    logging.getLogger("starhil").propagate = False
    units = sorted(bundled_units())
    with mutant.planted():
        for number, unit in enumerate(itertools.cycle(units)):
            icd, seed = load_unit(unit), 1 + number // len(units)
            outcome = run_once(make_life(unit_of(icd), unit, links_of(icd), seed, STEPS))
            if outcome.violation:
                return f"{time.process_time():.0f} s, {unit} seed {seed}: {outcome.violation}"
            if time.process_time() > 60.0 * minutes:
                break
    return ""


def main() -> None:
    """Plant all defects, one at a time."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument(
        "--minutes", type=float, default=10.0, help="longest search for one defect, of processor time"
    )
    parser.add_argument("--only", default="", help="only defects whose name contains this")
    options = parser.parse_args()
    mutants = [mutant for mutant in MUTANTS if options.only in mutant.name]
    missed = 0
    for mutant in mutants:
        with ProcessPoolExecutor(1, get_context("spawn")) as process:
            violation = process.submit(find, mutant, options.minutes).result()
        print(f"{mutant.name}: {violation or 'NOT FOUND'}", flush=True)
        missed += not violation
    print(f"{len(mutants) - missed} of {len(mutants)} found")
    sys.exit(bool(missed))


if __name__ == "__main__":
    main()
