# make demo: set up and run the main job · make test: set up and run the tests · make check: lint, format, types
.PHONY: setup demo test check clean help
.DEFAULT_GOAL := help

# The first of these that is 3.11 or later makes the virtual environment; override with `make setup PYTHON=...`.
PYTHON ?= $(shell for p in python3 python3.13 python3.12 python3.11; do \
  $$p -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null && echo $$p && break; done)
EXTRAS := measured,ros,px4,minari,rl,sb3,test,sysid
BIN := .venv/bin
STAMP := .venv/.installed

help: ## this list
	@grep -E '^[a-z]+:.*## ' $(MAKEFILE_LIST) | sed -E 's/^([a-z]+):.*## /make \1\t/'

setup: $(STAMP) ## create .venv and install all that the README uses

$(STAMP): pyproject.toml
	@test -n "$(PYTHON)" || { echo "No Python 3.11 or later found: install one, or say 'make $(MAKECMDGOALS) PYTHON=/path/to/python3.11'." >&2; exit 1; }
	@test -x $(BIN)/python || $(PYTHON) -m venv .venv || { rm -rf .venv; \
	  echo "Could not create .venv: on Debian and Ubuntu, 'apt install python3-venv'." >&2; exit 1; }
	@# Python compiles what is imported; compiling everything takes pip nearly as long again as installing it.
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-compile -e ".[$(EXTRAS)]"
	@touch $@

demo: setup ## run the whole loop on a simulated stand-in machine; the report lands in demo/
	@rm -rf demo
	$(BIN)/nfc-gym demo --out demo

test: setup ## run the test suite, or part of it: make test TESTS=tests/measured
	$(BIN)/python -m pytest $(TESTS)

check: setup ## lint, format and types
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright nfc_gym

clean: ## remove .venv, caches and the demo's output
	rm -rf .venv demo .pytest_cache .ruff_cache .hypothesis dist
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
