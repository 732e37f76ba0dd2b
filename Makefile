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
	@echo "make lock    resolve the dependencies anew into the two lock files"
	@echo "make clean   remove what was built; make distclean also removes $(VENV)"

setup: $(SET_UP)

$(SET_UP): requirements-dev.lock pyproject.toml tools/set_up.py
	$(PYTHON) tools/set_up.py --venv $(VENV)
	@touch $@

demo: $(SET_UP)
	$(BIN)/jiggle-mj run arc --out out/demo --overwrite

test: $(SET_UP)
	$(BIN)/pytest -m "not slow" -n 2 --dist loadfile

slow: $(SET_UP)
	$(BIN)/pytest -m slow

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

.PHONY: help setup demo test slow check lint types format lock clean distclean
