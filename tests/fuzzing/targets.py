"""The targets of fuzzing: each decoder of the wire and each reader of files, as a function of bytes.

A target raises nothing but what is documented, as one line of text; anything else is a defect. `tools/fuzz` drives the targets
by coverage; `test_corpus.py` repeats the inputs that were worth keeping.
"""

from tests.fuzzing import control, files, growth, wire
from tests.fuzzing.target import CORPUS, TARGETS, Target, read_corpus

__all__ = ["CORPUS", "TARGETS", "Target", "control", "files", "growth", "read_corpus", "wire"]
