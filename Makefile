# `make demo` and `make test` set up what they need in .venv, from PyPI, and nothing else.
PYTHON ?= python3
VENV ?= .venv
BIN = $(VENV)/bin
export ROS_AUTOMATIC_DISCOVERY_RANGE ?= LOCALHOST

# The documentation as a site, in docs/_build; a warning is an error.
docs: $(VENV)/.test
	$(BIN)/sphinx-build -q -W --keep-going -b html docs docs/_build

.PHONY: docs demo test report lint bench bench-long bench-small clean

demo: $(VENV)/.run
	$(BIN)/tdof-npid demo

report: $(VENV)/.paper
	$(BIN)/tdof-npid reproduce --out report

test: lint
	$(BIN)/python -m pytest -n 3 --dist loadfile --no-loadscope-reorder -m "not alone"
	$(BIN)/python -m pytest -m alone

lint: $(VENV)/.test
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports --no-cache

# The reference of the parameters, from their tables.
docs/parameters.md: tdof_npid_ros/parameter.py tdof_npid_ros/parameters.py tdof_npid_ros/reference.py $(VENV)/.run
	$(BIN)/python -m tdof_npid_ros.reference $@

bench: $(VENV)/.bench
	$(BIN)/python -m benchmarks

# What takes too long for `make bench`: ten minutes of realtime, ten seeds and 80,000 evaluations a row,
# twenty seeds on the plants from forums.
bench-long: $(VENV)/.bench
	$(BIN)/python -m benchmarks --only seeds forum soak

# Whether every benchmark still runs.
bench-small: $(VENV)/.bench
	$(BIN)/python -m benchmarks --size small --all --out $(VENV)/bench-small

# pip tells its progress on a terminal, in its own bars; in a log, a line for each package would be too much.
QUIET = $(shell test -t 2 || echo --quiet)

$(VENV)/.run: setup.py
	@echo "Setting up $(VENV): Python packages and ROS 2 Jazzy from PyPI, this once."
	test -d $(VENV) || $(PYTHON) -m venv $(VENV)
	@echo "[1/2] pip"
	$(BIN)/pip install --quiet --upgrade pip
	@echo "[2/2] tdof_npid_ros with ROS 2"
	$(BIN)/pip install $(QUIET) --editable ".[ros]"
	touch $@

$(VENV)/.paper: $(VENV)/.run
	$(BIN)/pip install --quiet --editable ".[ros,paper]"
	touch $@

$(VENV)/.test: $(VENV)/.run
	$(BIN)/pip install --quiet --editable ".[ros,test]"
	touch $@

$(VENV)/.bench: $(VENV)/.test
	$(BIN)/pip install --quiet --editable ".[ros,test,bench]"
	touch $@

clean:
	rm -rf $(VENV) build install log
