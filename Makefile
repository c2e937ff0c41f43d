# Everything a person needs: `make demo` shows it, `make test` proves it.
SHELL := /bin/bash
.SHELLFLAGS := -euo pipefail -c
.DEFAULT_GOAL := help
.NOTPARALLEL:
.PHONY: help demo test test-ci test-all test-mujoco3 fast lint type bench pictures experiments docs build clean

VENV := .venv
BIN := $(VENV)/bin
VENV3 := .venv-mujoco3
# Two workers are enough to hide one slow test; `make test WORKERS=8` uses more.
WORKERS ?= auto
# The first Python that is new enough; `make PYTHON=/path/to/python3.12 ...` names another.
PYTHON ?= $(shell for p in python3 python3.13 python3.12 python3.11; do \
	$$p -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null && command -v $$p && break; done)
# Whole files go to one worker, so that what they share is made once.
PYTEST = -m pytest -n $(WORKERS) --dist loadfile
OUTSIDE = docs or pool or browser
QUICK = not slow and not gpu and not network
# One thread for each process: the matrices are small, and tests run side by side.
export OMP_NUM_THREADS ?= 1
export OPENBLAS_NUM_THREADS ?= 1

help: ## show this
	@grep -hE '^[a-z-]+:.*## ' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/' | expand -t 12

demo: $(VENV)/.has-video ## climb a box: plan, physics, pictures and video, into runs/climb
	@$(BIN)/clamber climb --video

test: $(VENV)/.has-video $(VENV)/.has-test ## every test but the slow ones and those of test-ci
	$(BIN)/python $(PYTEST) -m "$(QUICK) and not ($(OUTSIDE))"

test-ci: $(VENV)/.has-video $(VENV)/.has-test ## what starts other programs: docs' blocks, process pools, browsers
	$(BIN)/python $(PYTEST) -m "$(QUICK) and ($(OUTSIDE))"

test-all: $(VENV)/.has-video $(VENV)/.has-test ## the slow tests too: whole climbs in physics
	$(BIN)/python $(PYTEST) -m "not gpu and not network"

test-mujoco3: | $(BIN)/python ## the tests of `make test` with the last MuJoCo 3, in an environment of their own
	@[ -x $(VENV3)/bin/python ] || $(BIN)/python -m venv $(VENV3)
	@grep -v '^mujoco' constraints.txt > $(VENV3)/constraints.txt
	@$(VENV3)/bin/python -m pip install --quiet --disable-pip-version-check \
		-c $(VENV3)/constraints.txt 'mujoco<4' -e '.[video,test]'
	$(VENV3)/bin/python $(PYTEST) -m "$(QUICK) and not ($(OUTSIDE)) and not compare"

fast: $(VENV)/.has-test $(VENV)/.has-dev ## for the edit loop: lint, then tests without a whole plan; what failed last comes first
	@$(BIN)/ruff check --quiet .
	$(BIN)/python $(PYTEST) -q -x --failed-first -m "$(QUICK) and not ($(OUTSIDE)) and not compare and not whole"

lint: $(VENV)/.has-dev ## ruff: rules and format
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

type: $(VENV)/.has-view $(VENV)/.has-video $(VENV)/.has-test $(VENV)/.has-dev ## pyright on src
	$(BIN)/pyright --pythonpath $(BIN)/python

bench: $(VENV)/.has-video $(VENV)/.has-compare ## time the stages, and the same jobs in other libraries
	@for f in benchmarks/bench_*.py; do echo "== $$f"; $(BIN)/python "$$f"; done

pictures: $(VENV)/.has-video ## the pictures of the documentation anew, from a climb
	rm -rf build/climb
	$(BIN)/clamber climb --out build/climb
	cp build/climb/climb.png docs/climb.png
	$(BIN)/clamber learn crossing --out build/policy/policy.json
	cp build/policy/policy.png docs/policy.png
	cp build/policy/policy-pelvis.png docs/policy-pelvis.png
	$(BIN)/python docs/tools/pictures.py docs/stages

experiments: $(VENV)/.has-video ## all experiments and their page in docs (hours; goes on where it stopped)
	for f in examples/experiments/*.yaml; do \
		$(BIN)/clamber sweep "$$f" --out "runs/$$(basename "$$f" .yaml)" || exit; done
	$(BIN)/python examples/experiments/page.py runs docs

docs: $(VENV)/.has-docs ## the documentation as a web site, into site/
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet
	@echo "open site/index.html"

build: $(VENV)/.has-dev ## wheel and sdist into dist/, tried out in an empty environment
	rm -rf dist build/empty
	$(BIN)/python -m build --outdir dist .
	$(PYTHON) -m venv build/empty
	build/empty/bin/python -m pip install --quiet --disable-pip-version-check -c constraints.txt dist/*.whl
	cd build && ./empty/bin/clamber --version
	cd build && ./empty/bin/python -c 'import clamber; clamber.load_demo("climb"); clamber.load_robot("coman")'
	rm -rf build/empty

clean: ## remove what make has made, but no runs
	rm -rf $(VENV) $(VENV3) build dist site .pytest_cache .ruff_cache

# A stamp for each extra that is installed: nothing is fetched twice, so make works offline afterwards.
$(VENV)/.has-%: pyproject.toml constraints.txt | $(BIN)/python
	@echo "installing clamber[$*] into $(VENV) ..."
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[$*]'
	@touch $@

$(BIN)/python:
	@if [ -z "$(PYTHON)" ]; then \
		echo "clamber needs Python 3.11 or newer and found none: install one, or name it with make PYTHON=/path/to/python3.11" >&2; exit 1; fi
	@"$(PYTHON)" -c 'import ensurepip, venv' 2>/dev/null || { \
		echo "$(PYTHON) cannot make a virtual environment: install python3-venv (Debian, Ubuntu), or name another with make PYTHON=..." >&2; exit 1; }
	@"$(PYTHON)" -m venv $(VENV)
