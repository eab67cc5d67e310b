# `make demo` and `make test` work in a fresh clone; both set up .venv first.
PYTHON ?= $(shell command -v python3.11 || command -v python3)
BIN := .venv/bin
SOURCES := $(sort $(wildcard leapnav/* leapnav/play/* envs/*.py envs/banks/*.bank experts/*.py \
    training/*.py training/*.toml training/*.jinja training/pretrained/*/*))

.PHONY: demo test lint types docs bench clean
.DELETE_ON_ERROR:

demo: .venv/installed
	$(BIN)/leapnav demo

# A process for each core: torch's threads would only be in each other's way.
test: lint types .venv/examples
	OMP_NUM_THREADS=1 $(BIN)/pytest -n auto --dist worksteal

lint: .venv/installed
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: .venv/installed
	$(BIN)/basedpyright

# Into build/site; needs no network once the packages are there.
docs: .venv/installed
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet
	@echo "wrote build/site/index.html"

bench: .venv/installed
	$(BIN)/pip install --quiet --constraint constraints.txt --editable ".[bench]" --config-settings editable_mode=strict
	$(BIN)/python benchmarks/environment.py
	$(BIN)/python benchmarks/expert.py
	$(BIN)/python benchmarks/solvers.py
	$(BIN)/python benchmarks/optima.py

clean:
	rm -rf .venv build *.egg-info

# A strict editable install, so that type checkers and editors resolve every import; it links the files that exist, so
# it is made again whenever one is added or removed.
.venv/installed: pyproject.toml constraints.txt .venv/sources
	$(BIN)/pip install --quiet --constraint constraints.txt --editable ".[dev]" --config-settings editable_mode=strict
	touch $@

.venv/examples: examples/requirements.txt .venv/bin/python
	$(BIN)/pip install --quiet --no-deps --upgrade --target $@ --requirement $<
	touch $@

.venv/sources: .venv/bin/python FORCE
	@echo "$(SOURCES)" | cmp --silent - $@ || echo "$(SOURCES)" > $@

.venv/bin/python:
	$(PYTHON) -m venv .venv
	$(BIN)/pip install --quiet --upgrade pip

FORCE:
