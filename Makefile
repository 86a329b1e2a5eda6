# make demo — the main job, end to end.   make test — lint, types, tests, notebooks.
# Both set up their own environment in .venv the first time.

PYTHON ?= $(shell command -v python3.11 || command -v python3)
VENV := .venv
BIN := $(VENV)/bin
INSTALLED := $(VENV)/.installed
SOURCES := bayes_impedance tests benchmarks docs conftest.py

.DEFAULT_GOAL := help
.PHONY: help demo test lint types format bench results docs faults hooks clean

help:
	@sed -n '1,2p' Makefile; echo "also: lint types format bench results docs faults hooks clean"

$(INSTALLED): pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
		{ echo "expected Python 3.11 or newer, found $$($(PYTHON) --version); set PYTHON=/path/to/python3.11"; exit 2; }
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt torch==2.13.0
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable '.[dev]'
	@touch $@

demo: $(INSTALLED)
	OMP_NUM_THREADS=1 $(BIN)/bayes-impedance demo --out demo

test: lint types
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n 2

lint: $(INSTALLED)
	$(BIN)/ruff check $(SOURCES)
	$(BIN)/ruff format --check $(SOURCES)

types: $(INSTALLED)
	$(BIN)/mypy

format: $(INSTALLED)
	$(BIN)/ruff check --fix $(SOURCES)
	$(BIN)/ruff format $(SOURCES)

# Times, each beside its competitor in the same run; writes benchmarks/results.json. A process for each file: the
# threads and the memory that one comparison leaves behind do not touch the next.
bench: $(INSTALLED)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable '.[bench]'
	for file in benchmarks/test_*.py; do \
		$(BIN)/python -m pytest $$file --benchmark-disable-gc -q -p no:cacheprovider -n 0 || exit 1; done

# The figures quoted in the README and the notebooks; writes results/*.json. Over an hour on two cores; on one
# thread each, so that rounding is the same everywhere.
results: $(INSTALLED)
	for part in core recordings reading human_experiment closed_loop simulated_arm planning coupled calibration sampling; do \
		OMP_NUM_THREADS=1 $(BIN)/python -m benchmarks.$${part}_results || exit 1; done

# The API reference, from the docstrings, in docs/api/.
docs: $(INSTALLED)
	$(BIN)/python docs/reference docs/api

# Five thousand generated inputs; writes results/faults.json unless one ends in a traceback.
faults: $(INSTALLED)
	OMP_NUM_THREADS=1 $(BIN)/python -m benchmarks.generated_inputs

hooks: $(INSTALLED)
	$(BIN)/pre-commit install

clean:
	rm -rf $(VENV) build dist demo docs/api .pytest_cache .mypy_cache .ruff_cache .hypothesis
