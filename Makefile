# make demo   everything from nothing: sets up, runs the main job, prints the comparison and where the report is
# make test   sets up and runs the tests
# make lint   ruff and mypy
#
# Needs Python 3.11 or newer with venv, and make. PYTHON=/path/to/python3.12 picks another interpreter.

PYTHON ?= python3
RUN ?= runs/demo
PRESET ?= quick
CORES := $(shell $(PYTHON) -c "import os; print(min(os.cpu_count() or 1, 4))" 2>/dev/null || echo 2)
BIN := .venv/bin

.PHONY: demo test lint setup setup-dev setup-check clean

demo: setup
	$(BIN)/nesy run --preset $(PRESET) --run "$(RUN)" --jobs $(CORES)

test: setup-dev
	$(BIN)/python -m pytest -n $(CORES) --dist loadfile

lint: setup-dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

setup: .venv/installed
setup-dev: .venv/installed-dev
# the independent tools, the browser driver, Ray and atheris, for the tests marked `check`, `browser`, `ray` and `fuzz`;
# without them those tests are skipped (the browser itself is a Debian package: chromium)
setup-check: .venv/installed-check

# The stamps are written last, so an interrupted installation is done again.
.venv/bin/python:
	@$(PYTHON) -c "import sys; sys.exit(sys.version_info < (3, 11))" \
	  || { echo "Python 3.11 or newer is needed; name one with: make PYTHON=/path/to/python3" >&2; exit 2; }
	$(PYTHON) -m venv .venv

.venv/installed: pyproject.toml constraints.txt | .venv/bin/python
	$(BIN)/python -m pip install --disable-pip-version-check -q -c constraints.txt -e .
	touch $@

.venv/installed-dev: .venv/installed
	$(BIN)/python -m pip install --disable-pip-version-check -q -c constraints.txt -e ".[dev]"
	touch $@

.venv/installed-check: .venv/installed-dev
	$(BIN)/python -m pip install --disable-pip-version-check -q -c constraints.txt -e ".[dev,check,browser,ray,fuzz]"
	touch $@

clean:
	rm -rf .venv build *.egg-info .mypy_cache .ruff_cache .pytest_cache
