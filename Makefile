# Needs Python >= 3.11, make and a package index (the one pip is configured for); nothing after `make setup` uses the network.

.DEFAULT_GOAL := help

VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/setup.stamp

# One thread of BLAS a process: the tests already run one process a core.
export OMP_NUM_THREADS ?= 1
export OPENBLAS_NUM_THREADS ?= 1
export MPLBACKEND ?= Agg

PYTEST := $(BIN)/python -m pytest -n auto --maxprocesses 4

.PHONY: help setup demo test test-all lint check examples format lock clean clean-all

help: ## List the targets
	@grep -hE '^[a-z-]+:.*## ' $(MAKEFILE_LIST) | sed -E 's/^([a-z-]+):.*## (.*)/  \1\t\2/' | expand -t 14

setup: $(STAMP) ## Make .venv with the pinned packages and this one (editable)

$(STAMP): requirements.lock pyproject.toml
	@set -e; python=""; \
	for name in python3 python3.11 python3.12 python3.13 python3.14; do \
	  if "$$name" -c 'import sys; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 14))' >/dev/null 2>&1; then \
	    python="$$name"; break; \
	  fi; \
	done; \
	if [ -z "$$python" ]; then \
	  echo "make setup: found no Python 3.11 to 3.14 (looked for python3, python3.11, ..., python3.14 on PATH)." >&2; \
	  echo "Install one of them, then run make setup again." >&2; \
	  exit 1; \
	fi; \
	echo "Making $(VENV) with $$("$$python" --version) ($$(command -v "$$python"))"; \
	"$$python" -m venv $(VENV)
	$(BIN)/python -m pip install --disable-pip-version-check --quiet --only-binary :all: --require-hashes -r requirements.lock
	$(BIN)/python -m pip install --disable-pip-version-check --quiet --no-index --no-deps --no-build-isolation -e .
	@touch $@

demo: $(STAMP) ## Plan a grasp of the casting and carry it out in physics
	$(BIN)/dyngrasp run scenarios/static_sdh2.toml

test: $(STAMP) ## Quick tests (minutes, offline)
	$(PYTEST)

test-all: $(STAMP) ## All tests, the slow ones too
	$(PYTEST) -m "slow or not slow"

lint: $(STAMP) ## Format, lint, types, import contracts
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/pyright
	$(BIN)/lint-imports

examples: $(STAMP) ## Run every script in examples/
	@set -e; for script in examples/*.py; do \
	  [ -e "$$script" ] || { echo "examples: there is no script in examples/"; break; }; \
	  echo "== $$script"; $(BIN)/python "$$script"; \
	done

check: ## Everything a change must pass: lint, tests, examples
	$(MAKE) lint
	$(MAKE) test
	$(MAKE) examples

format: $(STAMP) ## Rewrite the sources in the project's format
	$(BIN)/ruff check --fix-only --quiet .
	$(BIN)/ruff format .

lock: ## Pin the newest versions of everything again (needs uv on PATH and the network)
	uv pip compile --no-config --quiet --universal --python-version 3.11 --fork-strategy fewest --upgrade \
	  --generate-hashes --no-emit-index-url --no-header --extra dev pyproject.toml -o requirements.lock.new
	{ echo "# Every package that dyngrasp and its checks need, pinned, with the hashes of the files for all platforms."; \
	  echo "# Made by \`make lock\` from pyproject.toml; one set of versions for CPython 3.11 to 3.14 on Linux (x86-64, arm64) and macOS (Apple silicon)."; \
	  echo "# Install: python -m pip install --require-hashes -r requirements.lock"; \
	  cat requirements.lock.new; } > requirements.lock
	rm requirements.lock.new

clean: ## Remove caches and build products
	rm -rf build dist src/*.egg-info .pytest_cache .ruff_cache .hypothesis .import_linter_cache
	find src tests -name __pycache__ -type d -prune -exec rm -rf {} +

clean-all: clean ## The same, and .venv
	rm -rf $(VENV)
