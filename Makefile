# Everything runs in a virtual environment of its own, made on first use. Only what is imported is byte-compiled, when it
# is: to compile all libraries takes longer than to copy them.
PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
# Grid2Op's redispatch solver slows down sixfold on contended BLAS threads.
export OPENBLAS_NUM_THREADS := 1
# Libraries are compiled to byte code once: without it PyTorch and Grid2Op take seconds longer in every process.
unexport PYTHONDONTWRITEBYTECODE
WORKERS ?= 2
# The theme announces its successor at every build.
export NO_MKDOCS_2_WARNING := 1

.PHONY: help demo docs test test-slow lint release clean

help:
	@echo "make demo       train DQN on bus14, evaluate it, write reports/demo (a few minutes)"
	@echo "make test       linters, types, layers and the tests (eight minutes on two cores; thirteen the first time, which compiles)"
	@echo "make test-slow  the longer tests too, the site and the code blocks of the documentation among them"
	@echo "make docs       build the documentation into site/ (a minute), to be opened as site/index.html"
	@echo "make release    tests, builds the site and the packages, tries these out, and stops before the upload"
	@echo "make clean      remove the virtual environment and what was made"

$(VENV)/.installed: pyproject.toml constraints.txt
	@echo "== Creating the virtual environment $(VENV) and installing rl2grid (one to three minutes)"
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { echo "rl2grid needs Python 3.11 or newer: set PYTHON=/path/to/python3.11."; exit 1; }
	@$(PYTHON) -m venv $(VENV)
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check --progress-bar on --no-compile --constraint constraints.txt --editable ".[train,analysis,docs,dev]"
	@touch $@

# RLlib and TorchRL are large; a browser and notebooks are driven by the longer tests alone.
$(VENV)/.installed-examples: $(VENV)/.installed
	@echo "== Installing the libraries of the examples, of the notebooks and of the tests in a browser (about a minute)"
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check --progress-bar on --no-compile --constraint constraints.txt --editable ".[examples,browser,notebooks]"
	@touch $@

demo: $(VENV)/.installed
	@$(BIN)/rl2grid demo

docs: $(VENV)/.installed
	@$(BIN)/python -m mkdocs build --strict --quiet
	@echo "Written: site/index.html"

lint: $(VENV)/.installed
	@echo "== Style, types and layers"
	@$(BIN)/ruff check . && $(BIN)/ruff format --check .
	@$(BIN)/mypy
	@$(BIN)/lint-imports

test: lint
	@echo "== Tests"
	@$(BIN)/python -m pytest -m "not slow" -n $(WORKERS) --dist worksteal

test-slow: $(VENV)/.installed-examples
	@$(BIN)/python -m pytest -n $(WORKERS) --dist worksteal

release: $(VENV)/.installed
	@$(BIN)/python scripts/release.py

clean:
	rm -rf $(VENV) reports runs site .pytest_cache .mypy_cache .ruff_cache .import_linter_cache
