# Two commands on a fresh machine: `make demo`, `make test`. Each makes .venv when it is missing.
PYTHON ?= python3
BIN := .venv/bin
PIP := $(BIN)/python -m pip --disable-pip-version-check
STAMP := .venv/.armlab-installed

# Tests start many programs: with bytecode kept none of them compiles the package again.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: help setup demo test check docs bench api clean

help:  ## list the commands
	@grep -hE '^[a-z]+:.*## ' $(MAKEFILE_LIST) | awk -F ':.*## ' '{printf "make %-8s %s\n", $$1, $$2}'

$(STAMP): pyproject.toml constraints.txt CMakeLists.txt $(wildcard native/*.cpp native/*.h)
	@test -x $(BIN)/python || $(PYTHON) -m venv .venv
	@echo "Installing armlab and what it needs into .venv (about two minutes the first time)."
	PIP_CONSTRAINT=constraints.txt $(PIP) install --quiet --editable ".[dev]"
	@touch $@

setup: $(STAMP)  ## make .venv and install everything

demo: $(STAMP)  ## simulated YuMi over EGM: excite, identify, estimate a hand's force
	$(BIN)/armlab demo

test: $(STAMP)  ## the default tests
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest  # small matrices: more threads of BLAS only wait

check: $(STAMP)  ## linters and type checks
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright

docs: $(STAMP)  ## build the documentation into docs/_build, from scratch: nothing there is older than its source
	rm -rf docs/_build docs/_figures
	$(BIN)/sphinx-build -W --keep-going -q -j auto -b html docs docs/_build/html

bench: $(STAMP)  ## benchmarks side by side with peers (a separate environment)
	$(BIN)/python benchmarks/run.py

api: $(STAMP)  ## list the public names anew, after a change that is meant
	$(BIN)/python tests/style/test_public_api.py

clean:  ## remove what was built, keep logs
	rm -rf .venv .bench-venv build docs/_build
