# make run    sets everything up and runs one experiment
# make test   sets everything up, then lint, types, layers and tests (minutes)
# make test-slow  the long ones: twenty kill -9, ten thousand hostile requests, every command of
#                 the docs, the examples against a built wheel; browser-test needs Chromium
# make mutants  puts mistakes in at random, and tells which ones no test noticed (tests/mutants)
# make versions  the tests with the oldest versions that pyproject.toml admits (make oldest), and with
#                the newest (make newest); needs uv
# make ui     MLflow on the runs and sweeps in outputs/ (http://127.0.0.1:5000)
# make study  starts the study's server
# make bench  the benchmarks, whole
# make docs   the docs as a site, in build/site; make outputs runs what the docs show anew
PYTHON ?= python3
VENV ?= .venv
BIN = $(VENV)/bin
MADE = $(VENV)/.made
RUN = $(VENV)/.run
PEOPLE = $(VENV)/.people
READY = $(VENV)/.ready
PIP = $(BIN)/python -m pip install --disable-pip-version-check
CORES := $(shell getconf _NPROCESSORS_ONLN)
# A file at a time, in the order of tests/conftest.py: the longest first. Some tests wait more than
# they compute, so there is a process more than cores.
SPREAD = --dist loadfile --no-loadscope-reorder --numprocesses

.PHONY: run test style types tests test-docs test-slow browser-test versions oldest newest mutants lint docs outputs bench bench-quick study ui clean

run: $(RUN)
	$(BIN)/python -m xplain solver=pomcp domain=rescue lambda=1.5

# There is a process for each core: with more threads they would wait for each other.
tests browser-test bench-quick: export OMP_NUM_THREADS = 1

# mypy needs one core for a while: the tests begin beside it.
test: style
	$(MAKE) --jobs 2 types tests

tests: $(READY)
	$(BIN)/python -m pytest -q $(SPREAD) $(shell expr $(CORES) + 1)

test-docs: $(READY)
	$(BIN)/python -m pytest -q -m slow tests/test_docs.py tests/test_examples.py

test-slow: $(READY)
	$(BIN)/python -m pytest -q -m "slow and not browser"

# These files alone: each process would read all the others first. They are spread by file, and
# tests in a class apart.
browser-test: $(READY)
	$(BIN)/python -m pytest -q -m browser $(SPREAD) $(shell expr $(CORES) + 1) --dist loadscope $$(grep -rl --include='*.py' 'mark\.browser' tests)

# PYTHON is a version here, that uv finds.
versions: oldest newest
oldest: PYTHON = 3.11
oldest: WHICH = lowest-direct
newest: PYTHON = 3.13
newest: WHICH = highest
oldest newest:
	uv venv --clear --python $(PYTHON) build/$@
	uv pip install --python build/$@ --resolution $(WHICH) --editable ".[test,gym,docs]"
	NUMBA_CACHE_DIR=$(CURDIR)/build/$@/numba build/$@/bin/python -m pytest -q $(SPREAD) $(CORES)

# Interrupted, it goes on where it was; another SEED is another sample.
EACH ?= 8
SEED ?= 1
mutants: tests
	$(PIP) --constraint constraints.txt --editable ".[mutants]"
	$(BIN)/python -m tests.mutants --each $(EACH) --seed $(SEED)

lint: style types

style: $(READY)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/lint-imports

types: $(READY)
	$(BIN)/mypy

# Warnings are errors, also of links to pages, headings and pictures that are not there.
docs: $(READY)
	$(BIN)/sphinx-build --quiet --fail-on-warning --keep-going -c docs -d build/doctrees . build/site
	@echo "the site: build/site/index.html"

# The reference of all keys, what the commands in the docs print, and which tables are older, anew.
outputs: $(READY)
	$(BIN)/python docs/config_reference.py
	for page in README.md docs/*.md; do $(BIN)/python docs/run.py --write $$page || exit 1; done
	$(BIN)/python docs/tables.py --write

bench-quick: $(READY)
	$(BIN)/python benchmarks --quick

bench: $(READY)
	for file in benchmarks/[a-z]*.py; do $(BIN)/python $$file || exit 1; done

study: $(PEOPLE)
	$(BIN)/python -m xplain study

ui: $(RUN)
	$(BIN)/mlflow ui --backend-store-uri sqlite:///outputs/mlflow.db

$(MADE):
	$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "xplain needs Python 3.11 or newer: make PYTHON=python3.12 ...")'
	@echo "setting up $(VENV) (a minute or two, once)"
	$(PYTHON) -m venv --without-pip $(VENV)
	$(BIN)/python -m ensurepip  # what venv would do in silence
	$(PIP) --upgrade "pip>=25.1"  # shows its progress
	touch $(MADE)

# What a run needs, what people's pages need besides, and what tests and docs need.
$(RUN): $(MADE) pyproject.toml constraints.txt
	$(PIP) --constraint constraints.txt --editable .
	touch $(RUN)

$(PEOPLE): $(RUN)
	$(PIP) --constraint constraints.txt --editable ".[people]"
	touch $(PEOPLE)

$(READY): $(MADE) pyproject.toml constraints.txt
	$(PIP) --constraint constraints.txt --editable ".[test,gym,docs]"
	touch $(RUN) $(READY)

clean:
	rm -rf $(VENV) build dist .pytest_cache .mypy_cache .ruff_cache .hypothesis
