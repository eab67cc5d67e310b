# `make demo` and `make test` work in a fresh clone; both set up .venv first.
PYTHON ?= $(shell command -v python3.11 || command -v python3)
BIN := .venv/bin
SOURCES := $(sort $(shell find leapnav envs experts training -type f -not -path "*/__pycache__/*"))
# The build backend only warns that the installation refers to this directory.
INSTALL := PYTHONWARNINGS=ignore $(BIN)/pip install --quiet --no-compile --constraint constraints.txt --config-settings editable_mode=strict --editable
# One process per core; torch's threads would only compete with them.
PYTEST := OMP_NUM_THREADS=1 $(BIN)/pytest -n auto --dist worksteal

# Byte code is written when a module is first imported: compiling all installed files takes most of a minute, and few
# of them are imported. Many tests start processes, which load faster with byte code.
export PYTHONDONTWRITEBYTECODE :=

.PHONY: demo compile test test-all lint types docs bench coverage clean
.DELETE_ON_ERROR:

# Without the tools of the developers, unless they are installed already.
demo: $(if $(wildcard .venv/installed),.venv/installed,.venv/package)
	$(BIN)/leapnav demo

# Compiles what is not in the cache, on all cores.
compile: .venv/installed
	$(BIN)/leapnav compile

test: lint
	$(MAKE) --jobs=2 --output-sync types compile
	$(PYTEST)

# Long checks, see CONTRIBUTING.md.
test-all: test .venv/examples
	$(PYTEST) -m "slow"
	HYPOTHESIS_PROFILE=long $(PYTEST) tests/project/test_fuzz.py
	NUMBA_BOUNDSCHECK=1 LEAPNAV_CACHE_DIR=$(CURDIR)/build/bounds-checked $(PYTEST)
	$(BIN)/python scripts/build_banks.py --check
	$(BIN)/python scripts/check_installations.py

lint: .venv/installed
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	cd build/__editable__.leapnav-*/ && $(CURDIR)/$(BIN)/lint-imports --config $(CURDIR)/pyproject.toml --no-cache

types: .venv/installed
	$(BIN)/basedpyright

# Into build/site; needs no network once the packages are installed.
docs: .venv/installed
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet
	$(BIN)/python scripts/check_links.py build/site
	@echo "wrote build/site/index.html"

bench: .venv/installed
	$(INSTALL) ".[bench]"
	$(BIN)/python benchmarks/environment.py
	$(BIN)/python benchmarks/expert.py
	$(BIN)/python benchmarks/solvers.py
	$(BIN)/python benchmarks/optima.py
	$(BIN)/python benchmarks/growth.py
	$(BIN)/python benchmarks/stages.py
	$(BIN)/python benchmarks/lower_bounds.py
	$(BIN)/python benchmarks/labels.py
	$(BIN)/python benchmarks/moving.py

coverage: compile
	$(PYTEST) --cov=envs --cov=experts --cov=training --cov=leapnav --cov-report=term

clean:
	rm -rf .venv build *.egg-info

# A strict editable install, so that type checkers and editors resolve every import; it links the files that exist, so
# it is made again whenever one is added or removed.
.venv/installed: pyproject.toml constraints.txt .venv/sources
	$(INSTALL) ".[dev]"
	touch $@

.venv/package: pyproject.toml constraints.txt .venv/sources
	$(INSTALL) .
	touch $@

.venv/examples: examples/requirements.txt .venv/bin/python
	$(BIN)/pip install --quiet --no-deps --upgrade --target $@ --requirement $<
	touch $@

.venv/sources: .venv/bin/python FORCE
	@echo "$(SOURCES)" | cmp --silent - $@ || echo "$(SOURCES)" > $@

# The pip of Python 3.11 takes more than twice the time to install the tools of the developers.
.venv/bin/python:
	$(PYTHON) -m venv .venv
	$(BIN)/pip install --quiet --upgrade --constraint constraints.txt pip

FORCE:
