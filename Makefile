# Everything runs from the repository root; `make help` lists the targets.

SHELL := /bin/bash
.SHELLFLAGS := -eu -o pipefail -c
.DEFAULT_GOAL := help
.NOTPARALLEL:

PYTHON ?= python3
RECORDING ?=
PYTEST_ARGS ?=
# Tests of one file run one after the other; with an empty PARALLEL= all tests do.
PARALLEL ?= -n auto --dist loadfile --no-loadscope-reorder
# Tests of `make test` often wait for processes, so three workers keep two cores busy.
WORKERS := $(shell echo $$(($$(nproc 2>/dev/null || getconf _NPROCESSORS_ONLN) * 3 / 2)))
# The slowest tests are printed, and the time of each is written.
DURATIONS := --durations 50 --durations-min 1 --junitxml runs/tests.xml
# Tests that `make test` leaves out, each with a target of its own; test/conftest.py says which they are.
OTHER_RINGS := docs or package or campaign
# Message packages that `nox -s messages` builds; some benchmarks need them.
MESSAGES := .nox/message_packages/setup.bash
BENCHMARKS ?=
LONG ?=
OUT ?=
EXAMPLES ?=

VENV := .venv
BIN := $(VENV)/bin
COMMA := ,
SPACE := $(subst ,, )

# The ROS wheels restart python with these two variables, and children inherit them; the python of
# another environment would then load the wrong libraries.
ifdef _ROS_WHEELS_BOOTSTRAP_COMPLETE
unexport _ROS_WHEELS_BOOTSTRAP_COMPLETE LD_LIBRARY_PATH
CLEAN_ENV := env -u _ROS_WHEELS_BOOTSTRAP_COMPLETE -u LD_LIBRARY_PATH
endif

# Containers often set it, but then each of hundreds of processes compiles its libraries again.
unexport PYTHONDONTWRITEBYTECODE

# The interpreter behind PYTHON, so that an activated .venv does not become its own base.
BASE := $(shell $(CLEAN_ENV) $(PYTHON) -c 'import sys; print(getattr(sys, "_base_executable", sys.executable))' 2>/dev/null)
VERSION := $(if $(BASE),$(shell $(BASE) -c 'import sys; print("%d.%d" % sys.version_info[:2])'))
# Location of a sourced ROS 2, and location of one that this interpreter can't import.
SYSTEM_ROS := $(if $(BASE),$(shell $(BASE) -c 'import rclpy; print(rclpy.__path__[0])' 2>/dev/null))
FOREIGN_ROS := $(if $(BASE)$(SYSTEM_ROS),$(if $(SYSTEM_ROS),,$(shell $(BASE) -c \
	'import importlib.util as u; s = u.find_spec("rclpy"); print(s.origin if s else "")')))
WHEELS_EXIST := $(filter Linux-x86_64,$(shell uname -s)-$(shell uname -m))
ROS := $(if $(SYSTEM_ROS),system,$(if $(WHEELS_EXIST),wheels,none))
EXTRAS := $(if $(SYSTEM_ROS),dev-without-ros,dev)
DEMO_EXTRAS := bags,deploy,train,view$(if $(SYSTEM_ROS),,$(COMMA)ros)

# Written last, so that a half-built .venv lacks it and is built again; its name holds the Python and
# the ROS 2 of the environment. The demo needs only a part of it.
READY := $(VENV)/.ready-py$(VERSION)-$(ROS)
READY_FOR_DEMO := $(VENV)/.demo-py$(VERSION)-$(ROS)
# An environment that has lost its executables is installed again.
ifeq ($(wildcard $(BIN)/nics),)
.PHONY: $(READY) $(READY_FOR_DEMO)
endif
DESCRIBED_BY := setup.py setup.cfg package.xml pyproject.toml constraints.txt Makefile

OTHER_PYTHON := name another interpreter, as in: make setup PYTHON=python3.12

.PHONY: help setup demo test test-quick test-docs test-package test-campaign test-all ros-status lint format types pytest benchmark wheel tables docs models reference notebooks pictures clean distclean

help: ## list the targets
	@grep -hE '^[a-z-]+:.*## ' Makefile | sed -E 's/^([a-z-]+):.*## /\1\t/' | expand -t 15

setup: $(READY) ## build .venv: the package (editable) and everything that tests and demo need

# $(1): the environment's file. $(2): extras to install.
define BUILD
@if [ -z "$(BASE)" ]; then \
	echo "make setup: $(PYTHON) does not run here; $(OTHER_PYTHON)." >&2; exit 1; fi
@case "$(VERSION)" in 3.10|3.11|3.12|3.13|3.14) ;; *) \
	echo "make setup: $(PYTHON) is Python $(VERSION), but 3.10 to 3.14 is needed;" \
		"$(OTHER_PYTHON)." >&2; exit 1;; esac
@if ! $(BASE) -c 'import ensurepip, venv' 2>/dev/null; then \
	echo "make setup: $(BASE) has no venv module; install it (Debian, Ubuntu: apt install" \
		"python$(VERSION)-venv) or $(OTHER_PYTHON)." >&2; exit 1; fi
@if [ -n "$(FOREIGN_ROS)" ]; then \
	echo "make setup: the ROS 2 that is sourced here ($(FOREIGN_ROS)) does not load in Python" \
		"$(VERSION); take a shell without it, or $(OTHER_PYTHON)." >&2; exit 1; fi
@if [ ! -e $(READY) ] && [ ! -e $(READY_FOR_DEMO) ]; then \
	echo "Building $(VENV) with Python $(VERSION)."; \
	rm -rf $(VENV); \
	$(BASE) -m venv $(if $(SYSTEM_ROS),--system-site-packages) $(VENV); \
fi
@rm -f $(1)
@# A ROS 2 built against numpy 1 crashes on numpy 2, which some of the pins need.
@if [ "$(ROS)" = system ] && $(BASE) -c \
		'import numpy, sys; sys.exit(numpy.__version__[:2] != "1.")' 2>/dev/null; then \
	sed -E 's/^numpy==[^ ;]+/numpy<2/; /^(contourpy|matplotlib|scipy|shapely)==/d' \
		constraints.txt > $(VENV)/constraints.txt; \
else \
	cp constraints.txt $(VENV)/constraints.txt; \
fi
@echo "Installing nics_drl_bridge[$(2)] into $(VENV); the first time takes a minute or so."
@PIP_DISABLE_PIP_VERSION_CHECK=1 $(BIN)/python -m pip install -qq -c $(VENV)/constraints.txt uv
@$(UV_INSTALL) setuptools
@$(UV_INSTALL) --no-build-isolation --editable .
@# The kernels are compiled while the larger libraries arrive; for the demo, all that it needs.
@$(BIN)/nics warmup $(3) & compiling=$$!; \
	$(UV_INSTALL) $(TORCH) --no-build-isolation --editable '.[$(2)]' \
		|| $(if $(TORCH),$(UV_INSTALL) --no-build-isolation --editable '.[$(2)]',exit 1); \
	wait $$compiling || echo "make: the kernels are compiled when they are first called."
@touch $(1)
endef

# uv ignores pip's settings and, by default, the system's certificates. PyTorch's own index has Linux wheels without GPU libraries, which
# are a fifth of the size; without that index, the wheels with GPU libraries are used.
WHEELS := $(subst $(SPACE),$(COMMA),$(strip $(or $(UV_FIND_LINKS),$(PIP_FIND_LINKS))))
TORCH := $(if $(WHEELS),,--torch-backend cpu)
UV_INSTALL = UV_SYSTEM_CERTS=$${UV_SYSTEM_CERTS:-1} $(if $(WHEELS),UV_FIND_LINKS=$(WHEELS)) $(if $(PIP_INDEX_URL),UV_DEFAULT_INDEX=$(PIP_INDEX_URL)) \
	$(BIN)/uv pip install --quiet --python $(BIN)/python --constraints $(VENV)/constraints.txt

$(READY): $(DESCRIBED_BY)
	$(call BUILD,$@,$(EXTRAS))

$(READY_FOR_DEMO): $(DESCRIBED_BY)
	$(call BUILD,$@,$(DEMO_EXTRAS),--for-demo)

demo: $(or $(wildcard $(READY)),$(READY_FOR_DEMO)) ## run the whole chain on a recording: make demo [RECORDING=folder]
	$(BIN)/nics demo $(if $(RECORDING),--recording "$(RECORDING)") --out runs/demo

test: ros-status setup lint ## before each commit, as CI does: lint, types and tests: make test [PYTEST_ARGS="-k lidar"]
	@$(MAKE) --no-print-directory types & types=$$!; $(MAKE) --no-print-directory pytest; wait $$types

test-quick: setup ## in under a minute, after each edit: no processes, no training
	$(BIN)/python -m pytest -q $(PARALLEL) -m "not (ros or process or slow or $(OTHER_RINGS))" $(PYTEST_ARGS)

test-docs: setup ## examples, notebooks, commands and Python of the pages, and the site in a browser
	$(BIN)/python -m pytest $(PARALLEL) -m docs $(PYTEST_ARGS)

test-package: setup ## wheel and source archive, installations in fresh environments, without ROS 2
	$(CLEAN_ENV) $(BIN)/python -m pytest $(PARALLEL) -m package $(PYTEST_ARGS)

test-campaign: setup ## proofs of promises in their short forms, with their controls: faults, abuse, soak, fleets
	$(BIN)/python -m pytest $(PARALLEL) -m campaign --durations 0 --durations-min 1 $(PYTEST_ARGS)

test-all: test ## before a release: all rings, and the environments of noxfile.py
	$(MAKE) test-docs test-package test-campaign
	$(BIN)/nox

ros-status:
ifeq ($(ROS),system)
	@echo "ROS 2: yes, the system's ($(SYSTEM_ROS))."
else ifeq ($(ROS),none)
	@echo "ROS 2: no, none is sourced and there are no wheels for this machine; its tests skip."
else
	@if [ -e $(READY) ]; then echo "ROS 2: yes, as wheels in $(VENV)."; \
	else echo "ROS 2: not yet, set-up will install it as wheels into $(VENV)."; fi
endif

lint: setup ## ruff: rules and format
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

format: setup ## let ruff fix what it can
	$(BIN)/ruff check --fix-only .
	$(BIN)/ruff format .

types: setup ## mypy
	$(BIN)/mypy nics_drl_bridge

# Tests that wait for other processes may fail on a busy machine, so failed tests run again, alone.
# Kernels are compiled first, or several workers and their processes would each compile the same ones.
pytest: setup
	$(BIN)/nics warmup --all
	@status=0; $(BIN)/python -m pytest $(PARALLEL:auto=$(WORKERS)) -m "not ($(OTHER_RINGS))" $(DURATIONS) $(PYTEST_ARGS) || status=$$?; \
	if [ $$status = 1 ]; then \
		echo "make: once more, alone, the tests that failed:"; \
		$(BIN)/python -m pytest --last-failed --last-failed-no-failures none --maxfail 5 -m "not ($(OTHER_RINGS))" $(PYTEST_ARGS); \
	else exit $$status; fi

# Runs to the end even if a benchmark fails; each result names machine, commit and load.
benchmark: setup ## run every benchmark, in half an hour, write benchmarks/results.json: make benchmark [BENCHMARKS="parity barn"] [LONG=1] [OUT=file]
	@if [ -e $(MESSAGES) ]; then source $(MESSAGES); fi; \
		$(BIN)/python benchmarks/bench.py run \
		$(if $(BENCHMARKS),--only $(BENCHMARKS)) $(if $(LONG),--long) $(if $(OUT),--out "$(OUT)")

# The machine code is made beside a copy of the sources, so that the checkout stays as it is.
WHEEL ?= build/wheel
DIST ?= dist
wheel: setup ## a wheel in dist/ that carries machine code, so that nothing is compiled at first use
	rm -rf $(WHEEL) && mkdir -p $(WHEEL)/source
	$(BIN)/python -m build --sdist --no-isolation --outdir $(WHEEL) .
	tar -xzf $(WHEEL)/*.tar.gz --strip-components 1 -C $(WHEEL)/source
	cd $(WHEEL)/source && PYTHONPATH=$$PWD $(abspath $(BIN))/nics warmup --for-wheel
	$(BIN)/python -m build --wheel --no-isolation --outdir $(DIST) $(WHEEL)/source

tables: setup ## make the tables of README and docs from benchmarks/results.json
	@$(BIN)/python benchmarks/bench.py tables

docs: setup ## build the site of docs/ into build/docs
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict
	@echo "to read and search it: open build/docs/index.html in a browser"

models: setup ## generate config/models/ anew, after a change of the generator or of a shipped robot
	$(BIN)/python test/shipped_models.py

reference: setup ## make docs/reference/ from file schemas, commands and nodes
	$(BIN)/python docs/site/reference.py

notebooks: setup ## run docs/notebooks/ and keep the outputs
	$(BIN)/python docs/site/notebooks.py

pictures: setup ## run the examples and keep the pictures in docs/examples/: make pictures [EXAMPLES="own_task"]
	$(BIN)/python docs/site/pictures.py $(EXAMPLES)

clean: ## remove the products of building and testing
	rm -rf build dist install log *.egg-info .mypy_cache .pytest_cache .ruff_cache .hypothesis
	find . -name __pycache__ -not -path './.venv*' -prune -exec rm -rf {} +

distclean: clean ## also remove all environments (.venv and .nox) and runs/
	rm -rf $(VENV) .nox runs
