# Everything runs in .venv, which `make setup` builds from the committed versions. Needs Python >= 3.11 and make.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
PROFILE ?= smoke
ARGS ?=
EXTRAS := dev,view,slurm,gpu,objects,bench
# A package index for torch, for example https://download.pytorch.org/whl/cpu on machines without a GPU
TORCH_INDEX ?=

WBM := $(BIN)/wbm
WBM_ARGS = profile=$(PROFILE) $(ARGS)
include wbm.mk

.DEFAULT_GOAL := help
.PHONY: help setup run test check format bench pipeline ci wheel-test clean

help:
	@echo "make setup | run | test | check | format | bench | pipeline PROFILE=laptop | ci | clean"
	@echo "make assets | teachers | rollouts | student | evaluation | bundle    (PROFILE=..., ARGS='seed=1 ...')"

setup: $(VENV)/.installed

$(VENV)/.installed: pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --upgrade pip
	$(BIN)/pip install --quiet -c constraints.txt $(if $(TORCH_INDEX),--index-url $(TORCH_INDEX),) torch==2.13.0
	$(BIN)/pip install --quiet -c constraints.txt -e ".[$(EXTRAS)]"
	@touch $@

run: setup
	$(WBM) run profile=smoke $(ARGS)

test: setup
	$(BIN)/python -m pytest -n 2 --durations=10

check: setup
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright
	$(BIN)/lint-imports

format: setup
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

bench: setup
	$(WBM) bench all

pipeline: setup
	$(WBM) run profile=$(PROFILE) $(ARGS)

ci: check test
	$(WBM) run profile=smoke
	$(WBM) plan --check profile=smoke
	$(WBM) artifacts verify
	$(MAKE) wheel-test

# The built wheel alone, in an empty environment, outside the checkout.
wheel-test: setup
	rm -rf build/wheel && mkdir -p build/wheel
	$(BIN)/python -m build --wheel --no-isolation --outdir build/wheel/dist .
	$(PYTHON) -m venv build/wheel/venv
	build/wheel/venv/bin/pip install --quiet -c constraints.txt build/wheel/dist/*.whl
	cd build/wheel && venv/bin/wbm plan profile=smoke && venv/bin/wbm run profile=smoke

clean:
	rm -rf build dist .pytest_cache .ruff_cache .hypothesis
