# make serve        start the server with the bundled models, on port 8000 or on PORT
# make test         run every check and every test
# make lint         run the checks alone
# make format       rewrite the code as `make lint` wants it
# make page         build the page and its client from web/ into service/viewer; needs Node.js
# make webcam       put MediaPipe and its model into web/mediapipe, for the page's webcam; needs Node.js
# make bench        measure the server and write docs/benchmark.md; BENCH=--quick only prints
# make clean        remove caches and build outputs; keeps .venv, runs and stores

PYTHON ?= python3
PORT ?= 8000
BENCH ?=

VENV := .venv
BIN := $(VENV)/bin
PIP_INSTALL := $(BIN)/python -m pip install --quiet --quiet --disable-pip-version-check

.PHONY: serve test lint format page webcam bench clean

serve: $(VENV)/.core
	@$(BIN)/posefutures serve --port $(PORT)

test: lint
	$(BIN)/python -m pytest

lint: $(VENV)/.dev
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/lint-imports

format: $(VENV)/.dev
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

page: $(VENV)/.core
	cd web && npm ci --no-audit --no-fund
	$(BIN)/python web/openapi.py > web/openapi.json
	cd web && npm run client && npm run check && npm run build

webcam:
	cd web && npm ci --no-audit --no-fund && npm run webcam

bench: $(VENV)/.dev
	@PYTHONPATH=tests $(BIN)/python -m benchmarks $(BENCH)

clean:
	rm -rf build *.egg-info .mypy_cache .ruff_cache .pytest_cache .hypothesis .import_linter_cache
	find models service training tests -name __pycache__ -prune -exec rm -rf {} +

# One .venv: the dev install holds all of the core install, so it stamps both.
$(VENV)/.core: pyproject.toml | $(BIN)/python
	@echo "installing the server into $(VENV)"
	@$(PIP_INSTALL) --editable .
	@touch $@

$(VENV)/.dev: pyproject.toml | $(BIN)/python
	@echo "installing the server, PyTorch and the development tools into $(VENV)"
	@$(PIP_INSTALL) --editable '.[dev]'
	@touch $(VENV)/.core $@

$(BIN)/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null || { \
		echo "PYTHON=$(PYTHON): found $$($(PYTHON) --version 2>&1);" \
			"must be Python 3.11 or newer, such as make PYTHON=python3.12" >&2; exit 1; }
	$(PYTHON) -m venv $(VENV)
