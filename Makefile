# `make run` and `make test` need nothing but Python >= 3.11 with venv and pip.

VENV := .venv
BIN := $(VENV)/bin
PYTHON ?= $(shell for p in python3 python3.14 python3.13 python3.12 python3.11 python; do \
	$$p -c 'import sys, venv, ensurepip; sys.exit(sys.version_info < (3, 11))' 2>/dev/null \
	&& { command -v $$p; break; }; done)

# Without bytecode each command that a test starts would compile the package anew.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: help run test lint types layers kernels wheel sdist docs docs-version bench clean
.DELETE_ON_ERROR:

help:
	@echo 'make run      set up, then the main job: gpebo run plant=circuit estimator=drem'
	@echo 'make test     set up, then the tests'
	@echo 'make lint types layers    ruff and clang-format, mypy, import-linter'
	@echo 'make kernels  compile gpebo_cli/kernels again, after a change of the C'
	@echo 'make wheel    dist/gpebo-*.whl'
	@echo 'make sdist    dist/gpebo-*.tar.gz, which is built and tested from itself'
	@echo 'make docs     site/index.html, the documentation; the notebook is run'
	@echo 'make bench    docs/benchmarks.md, measured afresh; about ten minutes'
	@echo 'make clean    remove .venv and what tools leave behind; outputs/ is kept'

run: $(VENV)/installed
	$(BIN)/gpebo run plant=circuit estimator=drem
	@echo 'next: . $(BIN)/activate; gpebo list'

test: $(VENV)/installed-dev
	$(BIN)/pytest -n auto

lint: $(VENV)/installed-dev
	$(BIN)/ruff check
	$(BIN)/clang-format --dry-run -Werror gpebo_cli/kernels/*.[ch]

types: $(VENV)/installed-dev
	$(BIN)/mypy

layers: $(VENV)/installed-dev
	$(BIN)/lint-imports

# pip has compiled them once, with the package.
kernels: $(VENV)/installed-dev
	$(BIN)/python hatch_build.py

wheel: $(VENV)/installed-dev
	$(BIN)/python -m build --wheel --no-isolation

sdist:
	.ci/sdist dist

# The notebook is executed, so that it cannot say what is not so; --strict: no warnings.
docs: $(VENV)/installed-docs
	$(BIN)/python docs/notebook.py
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict

# The pages of one version on the branch gh-pages, beside those of others: make docs-version VERSION=1.2
docs-version: docs
	$(BIN)/mike deploy --push --update-aliases $(VERSION) latest
	$(BIN)/mike set-default --push latest

bench: $(VENV)/installed-bench
	$(BIN)/python -m benchmarks

clean:
	rm -rf $(VENV) build dist site .pytest_cache .mypy_cache .ruff_cache .hypothesis \
		.import_linter_cache
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

# Tests and tools are not what `make run` needs; a user should not wait for them.
$(VENV)/installed: pyproject.toml | $(VENV)/bin/pip
	$(BIN)/pip install --quiet --editable .
	@touch $@

$(VENV)/installed-dev: pyproject.toml | $(VENV)/bin/pip
	$(BIN)/pip install --quiet --editable '.[dev]'
	@touch $@ $(VENV)/installed

# Those it is compared with, one by one: one that does not install here is a row that says so.
$(VENV)/installed-bench: pyproject.toml | $(VENV)/bin/pip
	$(BIN)/pip install --quiet --editable '.[bench]' || { \
		$(BIN)/pip install --quiet --editable . sympy; \
		for p in casadi scikit-sundae solve-dae diffrax; do \
			$(BIN)/pip install --quiet $$p || true; \
		done; }
	@touch $@ $(VENV)/installed

$(VENV)/installed-docs: pyproject.toml | $(VENV)/bin/pip
	$(BIN)/pip install --quiet --editable '.[docs]'
	$(BIN)/pip install --quiet --no-deps 'sphinxcontrib-katex>=0.9.11,<0.10' # KaTeX alone
	@touch $@

$(VENV)/bin/pip:
	@test -n '$(PYTHON)' || { \
		echo 'no Python >= 3.11 with venv and ensurepip found; on Debian: apt install python3-venv' >&2; \
		exit 1; }
	$(PYTHON) -m venv $(VENV)
	@$(BIN)/pip --version > /dev/null
