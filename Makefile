# make demo        set up and run the product end to end; results in out/demo
# make test        set up and run all tests (those on a real vcan0 in a guest); the last lines say what ran, and why tests were skipped
# make check       for whoever edits, a minute or two: ruff, contracts of imports, and tests without processes and long computations
# make lowest      the tests marked `lowest` with the lowest versions of dependencies that pyproject.toml admits
# make versions    the same tests with the newest dependencies on VERSIONS of Python, on the Debians that have them (as root, on Debian)
# make arm64       the same bytes as here on an emulated arm64, and on the processor of an older server (as root, on Debian; an hour)
# make lint        ruff, mypy --strict and the contracts of imports
# make docs        pages and API reference in out/docs; a warning or a broken link fails
# make reproduce   every experiment of the thesis again; report.md, tables and plots in out/reproduce
# make cosmos      the COSMOS exports, read and driven by OpenC3's own code (installed apart, 110 MB)
# make fuzz        every decoder of the wire against a million mutated inputs (minutes; for the night)
# make fuzz-guided every decoder and reader of files against inputs guided by coverage, SECONDS (60) each
# make coverage    the tests of protocol, bench, device and links under measurement; fails below 95 % of lines and branches (docs/figures.md)
# make mutation    a random SAMPLE (40) of the mutants of each group of modules (MODULES: protocol/canopen, …); table in out/mutation
# make years       random lives of all units on JOBS (2) processors for HOURS (8), judged by an oracle (docs/endurance.md)
# make obc         a flight computer in QEMU reads the star tracker over its UART; report and truth log in out/obc
# make soak        the emulator under load and faults for MINUTES (15); fails if memory, descriptors or latency grow
PYTHON ?= python3
MINUTES ?= 15
HOURS ?= 8
SECONDS ?= 60
SAMPLE ?= 40
JOBS ?= 2
VENV := .venv
BIN := $(VENV)/bin
# pip's start-up look at the network for a newer pip is of no use here
export PIP_DISABLE_PIP_VERSION_CHECK := 1
# without bytecode, each of the hundreds of processes that tests start compiles the package again
unexport PYTHONDONTWRITEBYTECODE
# tests have more cameras, catalogues and processors than a user: within the usual 500 MB, a run would remove what the next one needs
export STARHIL_CACHE_LIMIT_MB ?= 2000

# a target whose recipe failed is made again: the file .venv/pyvenv.cfg is written before pip is found to be missing
.DELETE_ON_ERROR:
.PHONY: help demo check test lowest versions arm64 lint docs reproduce fuzz fuzz-guided coverage mutation soak years cosmos obc clean
help:
	@sed -n 's/^# make /make /p' Makefile

$(VENV)/pyvenv.cfg:
	@$(PYTHON) -c 'import sys; sys.exit(0 if sys.version_info >= (3, 11) else "starhil needs Python 3.11 or newer; call: make PYTHON=/path/to/python3.11")'
	@$(PYTHON) -c 'import sys; sys.exit(0 if sys.maxsize > 2**32 else "starhil needs a 64-bit system: x86-64 or arm64")'
	$(PYTHON) -m venv $(VENV)

$(VENV)/.product: pyproject.toml | $(VENV)/pyvenv.cfg
	$(BIN)/pip install --quiet --editable .
	@touch $@

# Python compiles what is imported; Basilisk (100 MB) is not available everywhere, and its tests are skipped then
$(VENV)/.developer: pyproject.toml | $(VENV)/pyvenv.cfg
	$(BIN)/pip install --quiet --no-compile --editable '.[test,lint,basilisk]' \
		|| $(BIN)/pip install --quiet --no-compile --editable '.[test,lint]'
	@touch $(VENV)/.product $(VENV)/.lab $@

demo: $(VENV)/.product
	$(BIN)/python tools/demo.py --out out/demo

# The tests in lanes, of which at most one more runs at once than there are processors, because two of them mostly wait. What is real to
# the clock, and the guest, which is long, come first; what computes gives way. BESIDE names targets that run among and after them.
LANES := vcan0 processes emulator computing
COMPUTING := tests/protocol tests/starid tests/conformance
WAITING := tests/process tests/emulator/console/test_browser.py tests/emulator/console/test_bad_day.py
lane-processes: TESTS := $(WAITING)
lane-emulator: TESTS := tests $(addprefix --ignore=,$(WAITING) $(COMPUTING))
lane-computing: TESTS := $(COMPUTING)
lane-emulator lane-computing: PRIORITY := nice
REPORTS := out/tests
WARM := $(BIN)/starhil cache warm
test: $(VENV)/.developer
	-@tools/install_test_packages tests obc
	@rm -rf $(REPORTS); mkdir -p $(REPORTS); for lane in $(LANES); do echo "ended without a report" >$(REPORTS)/$$lane.reason; done
	@$(WARM)
	@status=0; $(MAKE) --no-print-directory --jobs=$$(($$(nproc) + 1)) --keep-going --output-sync=target $(LANES:%=lane-%) $(BESIDE) || status=1; \
		[ $$status = 0 ] && echo "all passed" || echo "some failed: see the lines FAILED and ERROR above"; \
		$(BIN)/python tools/tier_table.py $(REPORTS); exit $$status
# the tests call make themselves, which would speak of the jobs of this one
lane-vcan0:
	@env -u MAKEFLAGS REPORTS=$(REPORTS) nice tools/test_on_vcan $(BIN)/python
lane-%:
	@env -u MAKEFLAGS $(PRIORITY) $(BIN)/python -m pytest -m "not socketcan" --junit-xml=$(REPORTS)/$*.xml $(TESTS)

# files all of whose tests have a marker; pytest's own selection would import all others, too
marked = $(shell grep -rl --include='test_*.py' 'pytestmark.*pytest\.mark\.$(1)\b' tests)
# beside the tests that start processes, without those marked as long: they compute for seconds, or wait for the clock or a peer
check: $(VENV)/.developer
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/lint-imports
	$(BIN)/python -m pytest -q -n auto --dist loadfile -m "not process and not browser and not socketcan and not long" \
		$(addprefix --ignore=,$(call marked,long) $(call marked,process) $(call marked,browser))

# what only tests need is of today; oem and others of the extra `test` need more than the lowest versions
LOWEST_TOOLS := 'pytest>=8' 'hypothesis>=6.100' msgpack cantools canmatrix space_packet_parser dcf-tools durand spiceypy
# the files marked with a dependency whose other versions can change what they test; others may need packages that are not installed there
LOWEST = $(call marked,lowest)
out/lowest/.installed: pyproject.toml tools/lowest_versions.py
	$(PYTHON) -m venv out/lowest
	$(PYTHON) tools/lowest_versions.py >out/lowest/constraints.txt
	out/lowest/bin/pip install --quiet --no-compile --constraint out/lowest/constraints.txt --editable '.[lab]' $(LOWEST_TOOLS)
	@touch $@

RUN_LOWEST = -m pytest -q -m "not process and not browser and not socketcan" \
	-k "not fuzz and not stateful and not mutant and not durand" $(LOWEST)

lowest: out/lowest/.installed
	nice out/lowest/bin/python $(RUN_LOWEST)

VERSIONS := trixie:3.13 forky:3.14
versions: export LOWEST_TESTS = $(RUN_LOWEST)
versions:
	@tools/install_test_packages roots
	@for each in $(VERSIONS); do python=python$${each#*:}; echo "$$python on Debian $${each%:*}"; \
		tools/debian_root $${each%:*} amd64 $$python,$$python-venv sh -ec "$$python -m venv ~/venv; \
			pip install --quiet --no-compile --upgrade --upgrade-strategy eager --editable '.[lab]' $(LOWEST_TOOLS); \
			nice python $$LOWEST_TESTS" || exit; done

ARM64 := tools/debian_root trixie arm64 python3.13,python3.13-venv
ARM64_VENV := out/roots/trixie-arm64-python3.13/root/venv
$(ARM64_VENV)/.installed: pyproject.toml
	@tools/install_test_packages arm64
	$(ARM64) sh -ec 'python3.13 -m venv ~/venv; pip install --quiet --no-compile --editable . pytest'
	@touch $@

arm64: $(VENV)/.developer $(ARM64_VENV)/.installed
	ARM64_ROOT="$(ARM64)" $(BIN)/python -m pytest -v --durations 0 tests/process/test_other_processor.py

lint: $(VENV)/.developer
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

$(VENV)/.lab: $(VENV)/.product
	$(BIN)/pip install --quiet --editable '.[lab]'
	@touch $@

$(VENV)/.docs: $(VENV)/.product
	$(BIN)/pip install --quiet --editable '.[docs]'
	@touch $@

docs: $(VENV)/.docs
	$(BIN)/python tools/make_reference.py
	rm -rf out/docs out/doctrees
	$(BIN)/python -m sphinx --quiet --fail-on-warning --keep-going --builder html --doctree-dir out/doctrees docs out/docs
	@echo "out/docs/index.html"

reproduce: $(VENV)/.lab
	$(BIN)/starid reproduce --output out/reproduce $(REPRODUCE)

fuzz: $(VENV)/.developer
	STARHIL_FUZZ_INPUTS=1000000 $(BIN)/python -m pytest tests/protocol/test_fuzz.py tests/protocol/serial/test_composed_faults.py tests/protocol/unit/test_unit_fuzz.py tests/protocol/canopen/test_slave_fuzz.py

$(VENV)/.measuring: $(VENV)/.developer
	$(BIN)/pip install --quiet --no-compile --editable '.[measuring]'
	@touch $@

fuzz-guided: $(VENV)/.measuring
	$(BIN)/python tools/fuzz.py --seconds $(SECONDS)

COVERING := $(addprefix tests/,protocol hil_tests conformance process $(addprefix emulator/,device links units control console))
coverage: $(VENV)/.measuring
	rm -rf out/coverage
	STARHIL_FUZZ_INPUTS=300 nice $(BIN)/python -m coverage run -m pytest -q -m "not socketcan and not browser" -k "not passes_the_wraps" $(COVERING)
	$(BIN)/python -m coverage combine -q
	$(BIN)/python -m coverage report

mutation: $(VENV)/.measuring
	nice $(BIN)/python tools/mutation.py $(MODULES) --sample $(SAMPLE) --jobs 2

soak: $(VENV)/.product
	$(BIN)/python tools/soak.py --minutes $(MINUTES)

years: $(VENV)/.product
	$(BIN)/starhil endurance --hours $(HOURS) --jobs $(JOBS) --seed $$(date +%s)

obc: $(VENV)/.product
	@tools/install_test_packages obc
	$(BIN)/python tools/obc_in_qemu.py $(OBC)

SITE := import site; print(site.getsitepackages()[0])
cosmos: $(VENV)/.developer
	$(PYTHON) -m venv --without-pip out/cosmos
	$(BIN)/python -c '$(SITE)' >"$$(out/cosmos/bin/python -c '$(SITE)')/product.pth"  # what the product has is not installed again
	$(BIN)/python -m pip --python out/cosmos/bin/python install --quiet openc3
	PYTHONPATH=$$(out/cosmos/bin/python -c '$(SITE)') \
		$(BIN)/python -m pytest -k cosmos tests/protocol/export/test_export.py tests/process/test_cosmos_plugin.py

clean:
	rm -rf $(VENV) out build dist
