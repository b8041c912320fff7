# Two commands on a fresh machine: `make demo`, `make test`. Each makes .venv when it is missing.
PYTHON ?= python3
BIN := .venv/bin
PIP := $(BIN)/python -m pip --disable-pip-version-check
STAMP := .venv/.armlab-installed

# Two tests at a time, as the smallest machine of today has two cores: one that waits for its robot costs the other
# nothing. Small matrices: with several threads BLAS would only wait for itself.
TOGETHER ?= 2
PYTEST := OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n $(TOGETHER) --dist worksteal

# Tests start many programs: with bytecode kept none of them compiles the package again.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: help setup demo test slow reference check docs bench fuzz soak api clean

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
	$(PYTEST)

# Only the files that say "slow" are read: the others, most of them, would be collected and left out.
slow: $(STAMP)  ## the tests marked slow; those of the pages read what make docs wrote
	$(PYTEST) -m slow --durations=25 $(sort $(shell grep -rlw --include='test_*.py' slow tests))

reference: $(STAMP)  ## tests of the kernels in NumPy; force and identification would take minutes, tests/contract holds them
	ARMLAB_KERNELS=reference $(PYTEST) -W "ignore:armlab runs its NumPy:RuntimeWarning" \
	  --ignore=tests/models/test_coupled.py $(addprefix tests/,kernels kinematics lie laws robots models)

check: $(STAMP)  ## linters and type checks
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright

docs: $(STAMP)  ## build the documentation into docs/_build, from scratch: nothing there is older than its source
	rm -rf docs/_build docs/_figures
	$(BIN)/sphinx-build -W --keep-going -q -j auto -b html docs docs/_build/html

bench: $(STAMP)  ## benchmarks side by side with peers (a separate environment)
	$(BIN)/python benchmarks/run.py

FUZZ_SECONDS ?= 600
fuzz: $(STAMP)  ## fuzz every decoder for FUZZ_SECONDS, guided by coverage
	@$(BIN)/python -c "import atheris" 2>/dev/null || \
	  $(PIP) install --quiet --only-binary :all: --constraint constraints.txt "atheris>=3.0" 2>/dev/null || \
	  { echo "Expected a Python that atheris has a wheel for, such as 3.11 on Linux, got another, or no network."; exit 1; }
	$(BIN)/python fuzz/run.py --seconds $(FUZZ_SECONDS)

SOAK_SECONDS ?= 1800
SOAK_ROBOT_SECONDS ?= 86400
soak: $(STAMP)  ## 30 min with everything on, then a day in lockstep; nothing may grow. SOAK_SECONDS, SOAK_ROBOT_SECONDS
	@status=0; \
	$(BIN)/python soak/run.py real_time --seconds $(SOAK_SECONDS) || status=1; \
	$(BIN)/python soak/run.py lockstep --seconds $(SOAK_ROBOT_SECONDS) || status=1; \
	exit $$status

api: $(STAMP)  ## list the public names anew, after a change that is meant
	$(BIN)/python tests/style/test_public_api.py

clean:  ## remove what was built, keep logs
	rm -rf .venv .bench-venv build docs/_build
