PYTHON ?= python3
TEST_WORKERS ?= 2
FAULTS ?= 20
FUZZ ?= 10000
FUZZ_SEED ?= 0

# Another Python has an environment of its own, such as .venv-python3.12, so that what was asked for
# is what runs.
VENV := .venv
ifneq ($(PYTHON),python3)
VENV := .venv-$(subst /,-,$(PYTHON:/%=%))
endif
BIN := $(VENV)/bin
BASE := $(VENV)/.base
DEV := $(VENV)/.dev
BENCH := $(VENV)/.bench
LIVE := $(VENV)/.live
TRAIN := $(VENV)/.train

PIP_INSTALL = $(BIN)/python -m pip install --quiet --disable-pip-version-check \
	--constraint constraints.txt --build-constraint constraints.txt

.DEFAULT_GOAL := help
.DELETE_ON_ERROR:
.PHONY: help demo live-demo test test-fast test-train check mutate fuzz licences format bench docs gallery constraints clean

help:  ## say what can be made
	@awk -F ':.*## ' '/^[a-z-]+:.*## / { printf "  make %-12s %s\n", $$1, $$2 }' Makefile
	@echo "Another Python, in an environment of its own: make test PYTHON=python3.12"

demo: $(BASE)  ## simulate a harbour, run the whole pipeline on it, say where the results lie
	$(BIN)/sightline demo

live-demo: $(LIVE)  ## watch a synthetic harbour live: boats move on a map in the browser
	$(BIN)/python examples/live_demo.py

test: $(DEV)  ## run all tests but those of training
	OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 \
		$(BIN)/python -m pytest -n $(TEST_WORKERS) --ignore tests/training

test-fast: $(DEV)  ## the same without the slow ones, those that failed last time first
	OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 \
		$(BIN)/python -m pytest -n $(TEST_WORKERS) -m "not slow" --failed-first --ignore tests/training

test-train: $(TRAIN)  ## install what trains detectors, train each for some steps on the CPU
	OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 \
		$(BIN)/python -m pytest -n $(TEST_WORKERS) tests/training

mutate: $(DEV)  ## plant small faults in the maths, say which no test notices (FAULTS=20 a package)
	$(BIN)/python tools/mutate.py --count $(FAULTS) --workers $(TEST_WORKERS) \
		camera georeferencing trajectory tracking evaluation

fuzz: $(DEV)  ## give every reader spoilt examples, say what neither reads nor refuses (FUZZ=10000)
	PYTHONPATH=tools $(BIN)/python -m fuzz --count $(FUZZ) --seed $(FUZZ_SEED) --workers $(TEST_WORKERS)

check: $(DEV)  ## what does not need running: style, format, types, direction of imports
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/mypy
	$(BIN)/lint-imports

licences: $(DEV)  ## list what the base installation brings, and refuse copyleft
	$(BIN)/python tools/licences.py

format: $(DEV)  ## put the code into the form that check wants
	$(BIN)/ruff check --fix
	$(BIN)/ruff format

bench: $(BENCH)  ## measure, beside the peers, what the README quotes
	@for script in benchmarks/[a-z]*.py; do \
		echo "$$script"; \
		OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 $(BIN)/python "$$script" || exit 1; \
	done

docs: $(DEV)  ## build the documentation into site/; any broken link is an error
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict --quiet
	@echo "The documentation lies in site/index.html"

gallery: $(BASE)  ## draw the pictures of the documentation's gallery anew
	@for script in examples/gallery/*.py; do \
		echo "$$script"; \
		OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 $(BIN)/python "$$script" docs/images/gallery || exit 1; \
	done

constraints: $(BASE)  ## renew constraints.txt with the newest versions that fit together
	$(BIN)/python tools/renew_constraints.py
	@echo "Now: make check test, then commit constraints.txt"

clean:  ## remove all that was made, the environments too
	rm -rf .venv .venv-* build dist site sightline-demo example-results benchmarks/results fuzz-findings
	rm -rf .mypy_cache .pytest_cache .ruff_cache .hypothesis .import_linter_cache
	find src tests tools examples benchmarks -name __pycache__ -type d -prune -exec rm -rf {} +

# Some systems ship Python without the part that puts pip into a new environment; the pip beside
# it can do that as well.
$(BIN)/python:
	@$(PYTHON) -c 'import sys; sys.exit(None if sys.version_info >= (3, 11) else "sightline \
	needs Python 3.11 or newer, and $(PYTHON) is older; say which: make PYTHON=python3.12 ...")'
	@echo "Creating the environment in $(VENV)"
	@$(PYTHON) -m venv $(VENV) >/dev/null 2>&1 || { \
		$(PYTHON) -m venv --clear --without-pip $(VENV) && \
		$(PYTHON) -m pip --python $(BIN)/python install --quiet --constraint constraints.txt pip; }

$(BASE): pyproject.toml constraints.txt | $(BIN)/python
	$(BIN)/python -m pip install --quiet --disable-pip-version-check \
		--constraint constraints.txt --upgrade pip
	$(PIP_INSTALL) --editable .
	@touch $@

$(DEV): $(BASE)
	$(PIP_INSTALL) --group dev
	@touch $@

$(LIVE): $(BASE)
	$(PIP_INSTALL) --editable '.[live]'
	@touch $@

$(TRAIN): $(DEV)
	$(PIP_INSTALL) --editable '.[train]'
	@touch $@

$(BENCH): $(DEV)
	$(PIP_INSTALL) --group bench
	@touch $@
