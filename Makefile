# Two commands to know:  make demo   and   make test.  Each installs into .venv when it is missing or out of date.
#
#   make demo ACCELERATOR=cuda13     with the GPU build of JAX (cuda12, cuda13)
#   make test PYTHON=python3.12      with another Python (3.11 to 3.13)
#   make demo ARGS="--help"          arguments for the command

PYTHON ?= python3
ACCELERATOR ?=
ARGS ?=
WORKERS ?= 2

VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed$(ACCELERATOR)
JAX := $(shell sed -n 's/^jax==\([^ ]*\).*/\1/p' requirements.lock)

# Each process takes neighbouring files, because the tests of a file share compiled programs.
PYTEST := $(BIN)/python -m pytest -n $(WORKERS) --dist worksteal

.PHONY: help demo native test test-slow test-results test-all soak coverage lint docs bench setup lock hooks clean
.DEFAULT_GOAL := help

help:
	@sed -n 's/^# \{0,1\}//p' Makefile | head -5
	@echo "targets: demo  native  test  test-slow  test-results  test-all  soak  coverage  lint  docs  bench  setup  lock  hooks  clean"

setup: $(STAMP)

$(STAMP): requirements.lock pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 13))' || \
	  { echo "make: $(PYTHON) is not Python 3.11 to 3.13; choose one with PYTHON=..." >&2; exit 2; }
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -r requirements.lock
ifneq ($(ACCELERATOR),)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check "jax[$(ACCELERATOR)]==$(JAX)"
endif
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation -e .
	@touch $@

demo: $(STAMP)
	$(BIN)/drivax demo --overwrite $(ARGS)

# Optional: a C++ compiler is all that it needs.
native: $(STAMP)
	$(BIN)/python native/build.py $(ARGS)

bench: $(STAMP)
	$(BIN)/drivax bench $(ARGS)

test: $(STAMP)
	$(PYTEST) -m "not slow" $(ARGS)

# What test-all runs in addition to test.
test-slow: $(STAMP)
	DRIVAX_OPTIMISED=1 $(PYTEST) -m slow $(ARGS)

# Whether the pages of results show the numbers that are stored.
test-results: $(STAMP)
	$(PYTEST) tests/test_results.py $(ARGS)

# Includes the native kernels, if there is a C++ compiler.
test-all: $(STAMP)
	if command -v $${CXX:-c++} > /dev/null; then $(BIN)/python native/build.py --strict; fi
	DRIVAX_OPTIMISED=1 $(PYTEST) $(ARGS)

MINUTES ?= 60

soak: $(STAMP)
	$(BIN)/python -m experiments.robustness soak --minutes $(MINUTES) $(ARGS)

coverage: $(STAMP)
	$(PYTEST) -m "not slow" --cov=drivax --cov-report=term:skip-covered $(ARGS)

lint: $(STAMP)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright
	$(BIN)/lint-imports --no-cache
	$(BIN)/python -m pytest -q -p no:cacheprovider tests/test_architecture.py tests/test_wording.py -k "machine or large or lock or names or words"

docs: $(STAMP)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -r requirements-docs.lock
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build

# Versions stay as they are unless ARGS=--upgrade or ARGS="--upgrade-package NAME".
LOCK := $(BIN)/uv pip compile --no-strip-extras --quiet --universal --python-version 3.11 --generate-hashes --no-header --no-annotate

lock: $(STAMP)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check uv
	$(LOCK) $(ARGS) pyproject.toml --extra all --group dev --output-file requirements.lock
	$(LOCK) $(ARGS) --group docs --constraint requirements.lock --output-file requirements-docs.lock

hooks: $(STAMP)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check pre-commit
	$(BIN)/pre-commit install

clean:
	rm -rf .cache .pytest_cache .ruff_cache .hypothesis .import_linter_cache build dist
	find src tests experiments docs -name __pycache__ -type d -prune -exec rm -rf {} +
