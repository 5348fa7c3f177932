# `make demo` and `make test` are all the set-up there is; both are incremental.
PYTHON ?= python3
# Test workers, one more than the two cores they are made for: tests of Ray and S3 wait more than they compute.
# Each imports every test (15 s of a core) and has up to 1.5 GB. 1 runs all in one process.
JOBS ?= 3

BIN := .venv/bin
TYPES := $(BIN)/pyright --pythonpath $(BIN)/python
DEMO := build/demo

.PHONY: help pictures demo paper-small paper model release test slow faults lint style types format docs site venv venv-labels clean
.DEFAULT_GOAL := help

help:
	@echo "make demo    600 labels on the built-in world, a picture and the next command (in $(DEMO))"
	@echo "make paper-small  labels, our network and the paper's, and tables on real houses, small (DATAGEN_ASSETS)"
	@echo "make paper   the same with as many labels as the paper has (in build/paper)"
	@echo "make model   the released model and its benchmark (in build/model)"
	@echo "make test    format check, lint, types, layers, tests"
	@echo "make release all that a release publishes, with digests, in build/release"
	@echo "make slow    the tests that make test leaves out: kills, dying clusters, most long ones"
	@echo "make faults  the full fault campaigns, as tables"
	@echo "make lint    the same without tests"
	@echo "make format  rewrite the code in the project's format"
	@echo "make docs    rewrite the pages that follow from schemas, robots and leaderboard"
	@echo "make pictures  draw the pictures of the documents again"
	@echo "make site    the documents as a site with search (in build/site); dead links fail"
	@echo "make venv    only the environment (.venv); PYTHON=python3.12 chooses another interpreter"
	@echo "make clean   remove everything that make made"

# Does nothing when pyproject.toml, constraints.txt and the interpreter are those of the last call.
define environment
	@command -v $(PYTHON) > /dev/null || { echo 'error: no $(PYTHON) here; name a Python 3.11 or newer: make PYTHON=...' >&2; exit 1; }
	@$(PYTHON) scripts/environment.py $(1)
endef

venv:
	$(call environment)

# Only what labels need: a quarter of the whole.
venv-labels:
	$(call environment,cluster labels)

demo: venv-labels
	@rm -rf $(DEMO)
	@mkdir -p $(DEMO)
	$(BIN)/datagen submit heuristic --n 600 --candidates in-range --out $(DEMO)/run
	$(BIN)/datagen show $(DEMO)/run --scene 9 --out $(DEMO)/scene.png
	@echo
	@echo "The picture: $(DEMO)/scene.png"
	@echo "Next, the cost of these labels: $(BIN)/datagen audit $(DEMO)/run"

# All three go on where they were stopped.
paper-small: venv
	@BIN=$(BIN) scripts/paper.sh small

paper: venv
	@BIN=$(BIN) scripts/paper.sh full

# 200,000 labels take about 20 minutes; NUMBER=HEURISTIC,PLAN makes fewer.
release: venv
	$(BIN)/python -m scripts.release build/release

model: venv
	@BIN=$(BIN) scripts/released_model.sh

# Runs are made durable file by file, which a shared disk takes ten times as long for as memory does. What
# failed stays there to be looked at. A test worker has one core: more threads would only wait for each other.
# Containers often keep Python from writing bytecode: each program that a test starts would be compiled again.
# Types are checked beside the tests: the checker has one thread and takes as long as a tenth of them.
SCRATCH := scratch=$$(mktemp -d -p /dev/shm 2>/dev/null || mktemp -d)
TESTS := PYTHONDONTWRITEBYTECODE= OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 $(BIN)/python -m pytest -q -n $(JOBS) --dist worksteal
test: style
	@$(SCRATCH); $(TYPES) > $$scratch/types 2>&1 & types=$$!; \
	$(TESTS) --basetemp=$$scratch/tests; tests=$$?; \
	wait $$types; types=$$?; cat $$scratch/types; \
	[ $$tests -eq 0 ] && [ $$types -eq 0 ] && rm -rf $$scratch

# What `make test` leaves out, for its time. CI runs both.
slow: venv
	@$(SCRATCH); $(TESTS) -m slow --basetemp=$$scratch/tests && rm -rf $$scratch

# Each ends with an error where a promise was broken.
FAULTS := crash_points damage kills executors two_drivers two_clusters s3 confinement swaps storage_errors \
	power_cut disks hostile_files hostile_meshes histories many_scenes many_commits
faults: venv
	@set -e; for name in $(FAULTS); do echo; echo "== $$name"; $(BIN)/python -m benchmarks.faults.$$name; done
	@echo; echo "== driver"; $(BIN)/python -m benchmarks.driver

lint: style types

style: venv
	$(BIN)/ruff format --check --quiet .
	$(BIN)/ruff check --quiet .
	$(BIN)/lint-imports --no-logo

types: venv
	$(TYPES)

format: venv
	$(BIN)/ruff check --fix --quiet . || true
	$(BIN)/ruff format .

docs: venv
	@mkdir -p build
	$(BIN)/python -m scripts.data_format_page > build/data-format.md
	mv build/data-format.md docs/reference/data-format.md
	$(BIN)/python -m scripts.specification_page > build/specification.md
	mv build/specification.md docs/reference/specification.md
	$(BIN)/python -m scripts.robots_page > build/robots.md
	mv build/robots.md docs/reference/robots.md
	$(BIN)/python -m scripts.leaderboard_page > build/leaderboard.md
	mv build/leaderboard.md docs/results/leaderboard.md

pictures: venv
	$(BIN)/python -m scripts.pictures

# Fails at dead links and at names that are not there. NO_MKDOCS_2_WARNING: an announcement of the theme's authors.
site: venv
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --quiet --strict
	@echo "the site is in build/site; to read it with its search: $(BIN)/python -m http.server --bind 127.0.0.1 -d build/site"

clean:
	rm -rf .venv build dist .pytest_cache .ruff_cache .hypothesis .import_linter_cache *.egg-info
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
