"""Plant each defect of tests/hil_tests/endurance/mutants.toml in a copy of the project and let endurance runs find it.

python tools/endurance_mutants.py [--minutes 10] [--only WORDS]

Prints the processor time and the violation with which each was found. The exit status is 1 if one was not found.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
import tomllib
from pathlib import Path

ROOT = Path(__file__).parent.parent
MUTANTS = ROOT / "tests" / "hil_tests" / "endurance" / "mutants.toml"
PACKAGES = ("starhil", "emulator", "protocol", "hil_tests", "configs", "starid")
SEARCH = """
import itertools, logging, sys, time
from starhil.emulator.cli.endurance import run_once
from starhil.emulator.launch.unit_in_memory import links_of
from starhil.hil_tests.endurance.life import make_life
from starhil.hil_tests.judge.definition import unit_of
from starhil.protocol.unit import load_unit
from starhil.protocol.files.bundled import bundled_units
logging.getLogger("starhil").addHandler(logging.NullHandler())
logging.getLogger("starhil").propagate = False
end = float(sys.argv[1])
for number, unit in enumerate(itertools.cycle(sorted(bundled_units()))):
    seed = 1 + number // len(bundled_units())
    icd = load_unit(unit)
    outcome = run_once(make_life(unit_of(icd), unit, links_of(icd), seed, 400))
    if outcome.violation:
        print(f"{time.process_time():.0f} s, {unit} seed {seed}: {outcome.violation}")
    if outcome.violation or time.process_time() > end:
        break
"""
"""Lives the lives of one seed after the other, of all units in turns, until a violation or the end of the time."""


def plant(copy: Path, mutant: dict[str, str]) -> None:
    """Plant a defect in a copy of the project; its text must occur once."""
    path = copy / mutant["file"]
    text = path.read_text(encoding="utf-8")
    if text.count(mutant["before"]) != 1:
        raise SystemExit(
            f"{mutant['name']}: its text occurs {text.count(mutant['before'])} times in {mutant['file']}"
        )
    path.write_text(text.replace(mutant["before"], mutant["after"]), encoding="utf-8")


def find(mutant: dict[str, str], minutes: float) -> str:
    """Return the processor time and the violation with which the defect was found, empty if it was not."""
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder)
        for name in PACKAGES:
            shutil.copytree(ROOT / name, copy / name, symlinks=True)
        plant(copy, mutant)
        environment = {**os.environ, "PYTHONPATH": str(copy), "PYTHONDONTWRITEBYTECODE": "1"}
        command = [sys.executable, "-c", SEARCH, str(60.0 * minutes)]
        run = subprocess.run(command, cwd=copy, env=environment, capture_output=True, text=True, check=False)
    return run.stdout.strip() or ((run.stderr.splitlines() or [""])[-1] if run.returncode else "")


def main() -> None:
    """Plant all defects, one at a time."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument(
        "--minutes", type=float, default=10.0, help="longest search for one defect, of processor time"
    )
    parser.add_argument("--only", default="", help="only defects whose name contains this")
    options = parser.parse_args()
    mutants = [
        item
        for item in tomllib.loads(MUTANTS.read_text(encoding="utf-8"))["mutant"]
        if options.only in item["name"]
    ]
    missed = []
    for mutant in mutants:
        violation = find(mutant, options.minutes)
        print(f"{mutant['name']}: {violation or 'NOT FOUND'}", flush=True)
        if not violation:
            missed.append(mutant["name"])
    print(f"{len(mutants) - len(missed)} of {len(mutants)} found")
    sys.exit(bool(missed))


if __name__ == "__main__":
    main()
