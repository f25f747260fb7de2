# Everything runs in .venv, which `make setup` builds from the committed versions. Needs Python >= 3.11 and make.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
PROFILE ?= smoke
ARGS ?=
EXTRAS := dev,view,slurm,gpu,objects,bench
# A package index for torch, for example https://download.pytorch.org/whl/cpu on machines without a GPU
TORCH_INDEX ?=
install_torch = $(1) install --quiet -c constraints.txt $(if $(TORCH_INDEX),--index-url $(TORCH_INDEX),) torch==2.13.0
# The newest bundle, when the command runs
BUNDLE = $$(ls -t $(CURDIR)/artifacts/bundle/*/*/policy.wbm | head -1)

WBM := $(BIN)/wbm
WBM_ARGS = profile=$(PROFILE) $(ARGS)
include wbm.mk

.DEFAULT_GOAL := help
.PHONY: help setup run test check format bench pipeline ci dist wheel-test clean

help:
	@echo "make setup | run | test | check | format | bench | pipeline PROFILE=laptop | dist | ci | clean"
	@echo "make assets | teachers | rollouts | student | evaluation | bundle    (PROFILE=..., ARGS='seed=1 ...')"

setup: $(VENV)/.installed

$(VENV)/.installed: pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --upgrade pip
	$(call install_torch,$(BIN)/pip)
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

# The source archive, and the wheel that is built from it.
dist: setup
	rm -rf dist
	$(BIN)/python -m build --no-isolation --outdir dist .

# The wheel in an empty environment, outside the checkout; then the runtime where a robot has NumPy and ONNX Runtime alone.
wheel-test: dist
	rm -rf build/wheel && mkdir -p build/wheel
	$(PYTHON) -m venv build/wheel/venv
	$(call install_torch,build/wheel/venv/bin/pip)
	build/wheel/venv/bin/pip install --quiet -c constraints.txt dist/*.whl
	cd build/wheel && venv/bin/wbm doctor && venv/bin/wbm plan && venv/bin/wbm run
	$(PYTHON) -m venv build/wheel/robot
	build/wheel/robot/bin/pip install --quiet -c constraints.txt numpy onnxruntime
	build/wheel/robot/bin/pip install --quiet --no-deps dist/*.whl
	cd build/wheel && robot/bin/python -m wbm.deploy verify $(BUNDLE)

clean:
	rm -rf build dist .pytest_cache .ruff_cache .hypothesis
