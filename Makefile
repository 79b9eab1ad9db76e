# Each target makes its own environment, $(VENV), from pyproject.toml first.
# Needed: Python 3.11 or newer with pip, make and a C compiler; the CPU's OpenCL comes with it.

PYTHON ?= $(shell python3.11 -c '' 2>/dev/null && echo python3.11 || echo python3)
VENV ?= .venv
STAMP = $(VENV)/made
RUN = $(VENV)/bin/python -m

.PHONY: demo test lint clean

demo: $(STAMP)
	$(RUN) clresample.demo $(ARGS)

test: $(STAMP)
	$(RUN) pytest $(ARGS)

lint: $(STAMP)
	$(RUN) ruff check .
	$(RUN) ruff format --check .

clean:
	rm -rf $(VENV) dist .pytest_cache .ruff_cache

# Without venv's own pip, which some systems package apart; the caller's pip installs into it.
$(STAMP): pyproject.toml
	$(PYTHON) -m venv --without-pip $(VENV)
	$(PYTHON) -m pip --python $(VENV)/bin/python install --quiet \
	    --editable '.[pocl,sim,plot,detect,dev]'
	touch $@
