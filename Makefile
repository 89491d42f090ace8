# make demo   the whole chain on a simulated site; results in demo-output/
# make test   linters, type check and all tests but the slow ones
# make test-all  the same with the slow ones, as CI does
# make fuzz   damaged files and messages with a fresh seed, for an hour; MINUTES=5 make fuzz: shorter
# make test-cpus  the tests as other makes of CPU round: six times as long
# make pages  every table of the measured pages in little: that it is made, and has the page's columns
# make check  linters and type check only
# make wheel  a wheel in dist/, the same to the last byte from the same commit, and its checksum
# make docs   the documentation site, in site/; it opens without a server and can be searched offline
#
# Each needs Python 3.11 or newer and nothing else; PYTHON=python3.12 make demo chooses another one.
# Tests that need real data skip unless KCAL_DATA names the folder that holds them.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
OUT := demo-output
MINUTES ?= 60

export PIP_DISABLE_PIP_VERSION_CHECK := 1

.DEFAULT_GOAL := demo
.PHONY: demo test test-all fuzz test-cpus pages check wheel docs clean

demo: $(VENV)/.installed
	$(BIN)/kcal demo --output $(OUT)
	@echo "results: $(CURDIR)/$(OUT); to use kcal in this shell: . $(BIN)/activate"

check: $(VENV)/.installed-dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

# The folder kcal is there for the examples in its docstrings. One thread in each of the two processes: commands and
# calibrations take one by themselves (kcal/threads.py), and what else tests compute would wait for each other.
# Compiled modules are kept, whatever the shell says: commands that tests start would compile all of kcal each time.
# A file's tests stay in one process, where they share what they have calibrated or rendered.
test test-all: export OMP_NUM_THREADS = 1
test test-all: export OPENBLAS_NUM_THREADS = 1
test test-all: export PYTHONDONTWRITEBYTECODE =
PYTEST := $(BIN)/python -m pytest -n 2 --dist loadfile --no-loadscope-reorder
test: check
	$(PYTEST) -m "not slow" kcal tests
	@echo "left out: $$(grep -rh '^ *@pytest.mark.slow' tests | wc -l) slow tests; make test-all runs them, too"

test-all: check
	$(PYTEST) kcal tests

fuzz: $(VENV)/.installed-dev
	$(BIN)/python -m scripts.fuzz --minutes $(MINUTES)

test-cpus: $(VENV)/.installed-dev
	$(BIN)/python -m scripts.check.cpus

pages: export OMP_NUM_THREADS = 1
pages: export OPENBLAS_NUM_THREADS = 1
pages: $(VENV)/.installed-dev
	$(BIN)/python -m scripts.measure --quick

wheel: $(VENV)/.installed-dev
	SOURCE_DATE_EPOCH=$$(git log -1 --format=%ct) $(BIN)/python -m pip wheel --quiet --no-deps --no-build-isolation \
	  --wheel-dir dist .
	cd dist && sha256sum *.whl

# The release of MkDocs is pinned, so its announcements of other programs are switched off.
docs: $(VENV)/.installed-docs
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --quiet --strict
	@echo "site: $(CURDIR)/site/index.html"

clean:
	rm -rf $(VENV) $(OUT) site

# The stamps make installation happen once, and again when what is to be installed changes.
$(VENV)/.python: | Makefile
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	  { echo "$(PYTHON) is older than Python 3.11; set PYTHON to a newer one"; exit 1; }
	$(PYTHON) -m venv $(VENV)
	touch $@

$(VENV)/.installed: $(VENV)/.python pyproject.toml constraints.txt
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable .
	touch $@

$(VENV)/.installed-dev: $(VENV)/.python pyproject.toml constraints.txt
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable '.[dev]'
	touch $@ $(VENV)/.installed

$(VENV)/.installed-docs: $(VENV)/.python pyproject.toml constraints.txt
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable '.[docs]'
	touch $@ $(VENV)/.installed
