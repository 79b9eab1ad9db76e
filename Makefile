# Each target makes its own environment, $(VENV), from pyproject.toml first.
# Needed: Python 3.11 or newer with pip, make and a C compiler; the CPU's OpenCL comes with it.

PYTHON ?= $(shell python3.11 -c '' 2>/dev/null && echo python3.11 || echo python3)
VENV ?= .venv
STAMP = $(VENV)/made
RUN = $(VENV)/bin/python -m
# Test files side by side, on up to four cores: most of a test's time is Python's. In their order:
# by numbers of tests the long files of few tests, such as tests/fields/test_kills.py, come last.
PYTEST = $(RUN) pytest -n auto --maxprocesses 4 --dist loadfile --no-loadscope-reorder

# Processes of tests, and those that these start, read each other's compiled modules.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: demo test test-on test-kernels-on grind lint mutants fuzz clean paper paper-full dist \
    test-as-gpu test-install test-oldest test-adapters threads docs kills \
    kernel-tests gpu-builds gpu-model

# What runs on one OpenCL device whatever the others are: operators, and the solver's kernels.
KERNEL_TESTS = tests/device/test_contraction.py tests/device/test_launcher.py \
    tests/device/test_selftest.py tests/resampling tests/paper \
    tests/deblending/test_lbfgs.py tests/deblending/test_structure.py \
    tests/deblending/test_boxed_start.py tests/deblending/test_small_kernels.py \
    tests/deblending/test_start_kernels.py

demo: $(STAMP)
	$(RUN) clresample.cli.demo $(ARGS)

test: $(STAMP)
	$(PYTEST) $(ARGS)

# make test-on RUNTIME=pocl|pocl-debian|intel|pair|rusticl [TESTS=...]: there alone.
# What it needs is fetched into .runtimes/; where that fails, it is skipped, and said so.
RUNTIME ?= pocl
TESTS ?= tests
test-on: $(STAMP)
	@PYTHON=$(PYTHON) tools/on_runtime.sh $(RUNTIME) $(PYTEST) $(TESTS) $(ARGS) || \
	    { status=$$?; [ $$status = 77 ] || exit $$status; }

# Kernels' tests on one other runtime.
test-kernels-on: TESTS = $(KERNEL_TESTS)
test-kernels-on: test-on

# What every kernel takes on GPUs of three vendors, compiled without one; ARGS='sm_90 --all'
gpu-builds: $(STAMP)
	@PYTHON=$(PYTHON) tools/on_runtime.sh gpu-compilers \
	    env PYTHONPATH=tools OMP_NUM_THREADS=1 $(RUN) gpu_builds $(ARGS) || \
	    { status=$$?; [ $$status = 77 ] || exit $$status; }

# What a GPU would take for joint fits, by arithmetic from counts made here: docs/gpu.md
gpu-model: $(STAMP)
	$(VENV)/bin/python tools/gpu_model.py $(ARGS)

# Their names, for bench/gpu_check.sh.
kernel-tests:
	@echo $(KERNEL_TESTS)

# Kernels' tests as kernels are built for GPUs, in buffers that show bad reads and writes.
test-as-gpu: $(STAMP)
	$(PYTEST) $(KERNEL_TESTS) --as-gpu --nan-buffers --guard-buffers $(ARGS)

# Renders and fits in several threads against the same alone, on that runtime.
threads: $(STAMP)
	@PYTHON=$(PYTHON) tools/on_runtime.sh $(RUNTIME) $(VENV)/bin/python tools/threads.py $(ARGS) || \
	    { status=$$?; [ $$status = 77 ] || exit $$status; }

# Races and bad accesses of every kernel, found by a simulator; see tools/grind.sh.
grind: $(STAMP)
	tools/grind.sh $(VENV)/bin/python

lint: $(STAMP)
	$(RUN) ruff check .
	$(RUN) ruff format --check .
	$(RUN) mypy

# Tries whether tests notice slips in a module, a package or the kernels:
# MODULE=clresample/sky ARGS='--n 100'
mutants: $(STAMP)
	$(RUN) tests.mutants $(MODULE) $(ARGS)

# The property tests with thousands of examples instead of a few.
fuzz: $(STAMP)
	CLRESAMPLE_EXAMPLES=$(or $(EXAMPLES),2000) $(RUN) pytest tests/properties $(ARGS)

# Every command killed in the midst of its writing, 56 times, a quarter of an hour; MODE=fields:
# whole fields killed thirty times at random moments, starved and damaged, half an hour.
MODE ?= commands
kills: $(STAMP)
	$(RUN) bench.kills $(MODE) $(ARGS)

# The paper's evidence, in bench/report/: report.md, which is kept, and its details. An interrupted
# run continues, a larger one adds.
paper: GALAXIES = 600
paper: GALAXIES_MORE = 120
paper: SECONDS = 1
paper: SCENES = 120
paper-full: GALAXIES = 10000
paper-full: GALAXIES_MORE = 10000
paper-full: SECONDS = 5
paper-full: SCENES = 2315
paper paper-full: $(STAMP)
	$(RUN) bench.paper.accuracy --galaxies $(GALAXIES)
	$(RUN) bench.paper.accuracy --wide --galaxies $(GALAXIES_MORE)
	$(RUN) bench.paper.accuracy --printed --galaxies $(GALAXIES_MORE)
	$(RUN) bench.paper.timing --seconds $(SECONDS)
	$(RUN) bench.paper.joint --scenes $(SCENES)
	$(RUN) bench.paper.report

# Wheel and sdist in dist/, checked as a package index will check them.
dist: $(STAMP)
	rm -rf dist
	$(RUN) build --outdir dist
	$(RUN) twine check --strict dist/*

# The wheel in a clean environment of each Python, far from the checkout: smoke tests, the command.
PYTHONS ?= python3.11 python3.12 python3.13
test-install: dist
	for python in $(PYTHONS); do UV=$(VENV)/bin/uv tests/install/try_install.sh $$python newest dist/*.whl || exit 1; done

# The same with the oldest dependencies that pyproject.toml allows.
test-oldest: dist
	UV=$(VENV)/bin/uv tests/install/try_install.sh $(PYTHON) oldest dist/*.whl

# The bridges with the real JAX, PyTorch, scarlet2, GalSim, photutils and regions: 6 GB, of their own.
test-adapters: VENV = .venv-adapters
test-adapters: .venv-adapters/made
	$(RUN) pytest tests/adapters $(ARGS)

.venv-adapters/made: pyproject.toml
	$(PYTHON) -m venv --without-pip .venv-adapters
	$(PYTHON) -m pip --python .venv-adapters/bin/python install --quiet \
	    --editable '.[pocl,jax,torch,scarlet2,galsim,photutils,regions,dev]'
	touch $@

# The pages, with every example executed, in docs/_build/html/index.html; a warning is an error.
docs: .venv-docs/made
	.venv-docs/bin/python -m sphinx -W --keep-going -q -b html docs docs/_build/html
	@echo docs/_build/html/index.html

.venv-docs/made: pyproject.toml
	$(PYTHON) -m venv --without-pip .venv-docs
	$(PYTHON) -m pip --python .venv-docs/bin/python install --quiet \
	    --editable '.[pocl,sim,plot,field,jax,docs]'
	touch $@

clean:
	rm -rf $(VENV) .venv-adapters .venv-docs .runtimes docs/_build dist .pytest_cache .ruff_cache

# Without venv's own pip, which some systems package apart; the caller's pip installs into it.
$(STAMP): pyproject.toml
	$(PYTHON) -m venv --without-pip $(VENV)
	$(PYTHON) -m pip --python $(VENV)/bin/python install --quiet \
	    --editable '.[pocl,sim,plot,field,hats,jwst,dask,dev]'
	touch $@
