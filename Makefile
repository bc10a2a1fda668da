# Everything here is repeatable and needs only Python 3.11 to 3.13 and a package index.
PYTHON ?= python3
BIN := .venv/bin
INSTALLED := .venv/.installed
# each test process would compile every module again
unexport PYTHONDONTWRITEBYTECODE

.PHONY: help install demo test test-all test-gpu lint docs ledger format lock clean

help:  ## show this list
	@grep -E '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/' | expand -t 12

install: $(INSTALLED)  ## make .venv and install hudepth with its development tools

$(INSTALLED): pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(not (3, 11) <= sys.version_info < (3, 14))' \
	  || { echo "hudepth needs Python 3.11 to 3.13; pass PYTHON=<one of them>"; exit 1; }
	test -x $(BIN)/python || $(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[dev]'
	@touch $@

demo: $(INSTALLED)  ## train and test a first model on built-in rooms, in under 3 minutes
	$(BIN)/hudepth-train +experiment=demo

test: $(INSTALLED)  ## run the fast tests, in a few minutes
	$(BIN)/python -m pytest -n auto --dist worksteal --durations 25 -m "not slow"

test-all: $(INSTALLED)  ## run all tests, as continuous integration does
	$(BIN)/python -m pytest -n auto --dist worksteal --durations 25

test-gpu: $(INSTALLED)  ## run the tests that need an NVIDIA GPU
	$(BIN)/python -m pytest --durations 25 -m gpu tests/cuda

lint: $(INSTALLED)  ## ruff and mypy --strict
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

docs: $(INSTALLED)  ## build the documentation into build/docs, with every warning an error
	$(BIN)/python -m sphinx --fail-on-warning --nitpicky --quiet docs build/docs

ledger: $(INSTALLED)  ## check every claim of the paper; ARGS="--runs DIR ..." adds runs as evidence
	$(BIN)/python -m experiments.ledger $(ARGS)

format: $(INSTALLED)  ## format the code
	$(BIN)/ruff check --fix --exit-zero .
	$(BIN)/ruff format .

lock:  ## write uv.lock with the versions of constraints.txt; needs uv
	uv lock --no-config --default-index https://pypi.org/simple \
	  $$(sed -n 's/^\([A-Za-z].*\)/--upgrade-package \1/p' constraints.txt)

clean:  ## remove .venv, caches and build results; runs stay
	rm -rf .venv build dist *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
