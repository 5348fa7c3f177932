# `make demo` and `make test` are all the set-up there is; both are incremental.
PYTHON ?= python3
# Test workers; 1 runs them in one process.
JOBS ?= 2

BIN := .venv/bin
DEMO := build/demo

.PHONY: help demo paper-small paper test faults lint format docs venv clean
.DEFAULT_GOAL := help

help:
	@echo "make demo    600 labels on the built-in world, a picture, status and audit (in $(DEMO))"
	@echo "make paper-small  labels, training and tables on real houses, small (DATAGEN_ASSETS; in build/paper-small)"
	@echo "make paper   the same with as many labels as the paper has (in build/paper)"
	@echo "make test    format check, lint, types, layers, tests"
	@echo "make faults  the full fault campaigns, as tables"
	@echo "make lint    the same without tests"
	@echo "make format  rewrite the code in the project's format"
	@echo "make docs    rewrite docs/data-format.md and docs/specification.md from the schemas"
	@echo "make venv    only the environment (.venv); PYTHON=python3.12 chooses another interpreter"
	@echo "make clean   remove everything that make made"

# Does nothing when pyproject.toml, constraints.txt and the interpreter are those of the last call.
venv:
	@command -v $(PYTHON) > /dev/null || { echo 'error: no $(PYTHON) here; name a Python 3.11 or newer: make PYTHON=...' >&2; exit 1; }
	@$(PYTHON) scripts/environment.py

demo: venv
	@rm -rf $(DEMO)
	@mkdir -p $(DEMO)
	$(BIN)/datagen submit heuristic --n 600 --out $(DEMO)/run
	$(BIN)/datagen show $(DEMO)/run --scene 0 --out $(DEMO)/scene-0.png
	$(BIN)/datagen status $(DEMO)/run
	$(BIN)/datagen audit $(DEMO)/run
	@echo "the picture: $(DEMO)/scene-0.png"

# Both go on where they were stopped.
paper-small: venv
	@BIN=$(BIN) scripts/paper.sh small

paper: venv
	@BIN=$(BIN) scripts/paper.sh full

# Runs are made durable file by file, which a shared disk takes ten times as long for as memory does. What
# failed stays there to be looked at. A test worker has one core: more threads would only wait for each other.
test: lint
	@scratch=$$(mktemp -d -p /dev/shm 2>/dev/null || mktemp -d); \
	OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 \
	$(BIN)/python -m pytest -q -n $(JOBS) --dist loadfile --no-loadscope-reorder --basetemp=$$scratch/tests \
	&& rm -rf $$scratch

# Each ends with an error where a promise was broken.
FAULTS := crash_points damage kills executors two_drivers s3 confinement listing swaps storage_errors hostile_files many_scenes
faults: venv
	@set -e; for name in $(FAULTS); do echo; echo "== $$name"; $(BIN)/python -m benchmarks.faults.$$name; done
	@echo; echo "== driver"; $(BIN)/python -m benchmarks.driver

lint: venv
	$(BIN)/ruff format --check --quiet .
	$(BIN)/ruff check --quiet .
	$(BIN)/lint-imports --no-logo
	$(BIN)/pyright --pythonpath $(BIN)/python

format: venv
	$(BIN)/ruff check --fix --quiet . || true
	$(BIN)/ruff format .

docs: venv
	@mkdir -p build
	$(BIN)/python -m datagen.schemas.data_format > build/data-format.md
	mv build/data-format.md docs/data-format.md
	$(BIN)/python -m datagen.schemas.specification_page > build/specification.md
	mv build/specification.md docs/specification.md

clean:
	rm -rf .venv build dist .pytest_cache .ruff_cache .hypothesis .import_linter_cache *.egg-info
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
