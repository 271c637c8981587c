"""Write the generated tables of the pages in docs/, and the interface definition of the default unit among them.

Run `python tools/make_reference.py`. tests/test_reference.py and tests/test_docs.py compare the files with the code.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Final

from starhil.emulator.cli.reference import BLOCK, with_tables
from starhil.protocol.export import export
from starhil.protocol.files.bundled import DEFAULT_UNIT
from starhil.protocol.unit import load_unit

ROOT: Final = Path(__file__).resolve().parent.parent


def pages() -> list[Path]:
    """Return the files that contain generated tables."""
    return [
        path
        for path in sorted((ROOT / "docs").glob("*.md"))
        if BLOCK.search(path.read_text(encoding="utf-8"))
    ]


def main() -> None:
    """Write what has changed."""
    texts = {path: with_tables(path.read_text(encoding="utf-8")) for path in pages()}
    texts[ROOT / "docs" / "icd" / f"{DEFAULT_UNIT}.md"] = export(load_unit(), "markdown")
    for path, text in texts.items():
        if not path.exists() or path.read_text(encoding="utf-8") != text:
            path.write_text(text, encoding="utf-8")
            print(f"{path.relative_to(ROOT)}: written", file=sys.stderr)


if __name__ == "__main__":
    main()
