# Two commands on a fresh machine: 'make demo' and 'make test'. Each sets up what is missing first.
PYTHON ?= python3
VENV ?= .venv
BIN := $(abspath $(VENV))/bin
export MUJOCO_GL ?= egl

SET_UP := $(VENV)/.set-up

help:
	@echo "make demo    set up, then find where a tissue is attached; the report is out/demo/report.html"
	@echo "make test    set up, then run the fast tests"
	@echo "make check   format, lint, types and tests"
	@echo "make format  rewrite the sources in the house's format"
	@echo "make slow    the tests that take minutes"
	@echo "make defaults  tests whose claim is about bits, compiled with XLA's default flags"
	@echo "make versions  the fast tests with each newer Python that this machine has"
	@echo "make lock    resolve the dependencies anew into the two lock files"
	@echo "make clean   remove what was built; make distclean also removes $(VENV)"

setup: $(SET_UP)

$(SET_UP): requirements-dev.lock pyproject.toml tools/set_up.py
	$(PYTHON) tools/set_up.py --venv $(VENV)
	@touch $@

demo: $(SET_UP)
	$(BIN)/jiggle-mj run arc --out out/demo --overwrite

test: $(SET_UP)
	$(BIN)/pytest -m "not slow" -n 2 --dist loadgroup

# All other tests compile without optimisation, for speed: what they say of bits holds for another program.
defaults: $(SET_UP)
	XLA_FLAGS= $(BIN)/pytest -m "bits and not slow" -n 2

# PYTHONS names them: those on PATH, and pyenv's.
PYTHONS ?= $(foreach v,3.12 3.13,$(firstword $(wildcard $(HOME)/.pyenv/versions/$(v).*/bin/python) $(shell command -v python$(v))))

versions:
	@test -n "$(strip $(PYTHONS))" || echo "versions: no Python newer than this one is installed; nothing was tested"
	for python in $(PYTHONS); do \
	  $(MAKE) PYTHON=$$python VENV=build/venv-$$(basename $$(dirname $$(dirname $$python))) test || exit 1; \
	done

slow: $(SET_UP)
	$(BIN)/pytest -m slow -o faulthandler_timeout=0

check: lint types test

lint: $(SET_UP)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: $(SET_UP)
	$(BIN)/pyright --pythonpath $(BIN)/python

format: $(SET_UP)
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

# Neither this machine's uv settings nor its pip settings reach the locks: uv reads no pip settings, and is given none.
LOCK := $(BIN)/uv pip compile --quiet --no-config --universal --python-version 3.11 --fork-strategy fewest \
	--generate-hashes --no-header --no-emit-index-url --no-emit-find-links $(LOCKFLAGS)

# LOCKFLAGS=--upgrade moves to the newest versions; without it, what is locked stays.
lock: $(SET_UP)
	$(BIN)/python -m pip install --quiet uv
	env -u UV_INDEX -u UV_INDEX_URL -u UV_DEFAULT_INDEX -u UV_EXTRA_INDEX_URL -u UV_FIND_LINKS $(SHELL) -euc ' \
	  $(LOCK) pyproject.toml --output-file requirements.lock; \
	  $(LOCK) pyproject.toml --group dev --constraint requirements.lock --output-file requirements-dev.lock'

clean:
	rm -rf build dist *.egg-info .pytest_cache .ruff_cache .hypothesis

distclean: clean
	rm -rf $(VENV)

.PHONY: help setup demo test slow defaults versions check lint types format lock clean distclean
