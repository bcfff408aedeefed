# `make train` and `make test` do everything on a machine with Python >= 3.11 and make.
PYTHON ?= python3
comma := ,
# JAX with CUDA where there is an NVIDIA driver.
EXTRAS ?= dev$(if $(shell command -v nvidia-smi),$(comma)cuda)
# In the order of tests/conftest.py, which begins with the files that take longest.
TEST_FLAGS ?= -n auto --maxprocesses 4 --dist loadfile --no-loadscope-reorder
ARGS ?=

BIN := .venv/bin
INSTALLED := .venv/.installed-$(subst $(comma),-,$(EXTRAS))
SOURCES := mjx_grasp tests experiments benchmarks examples docs

.PHONY: help setup train demo test test-long lint format docs paper readme revision clean
.DEFAULT_GOAL := help

help:
	@echo "make train      set up, train the preset of this hardware, evaluate, write a report"
	@echo "                (ARGS='--preset paper' passes arguments on)"
	@echo "make demo       set up, grasp a can by its top, write demo/index.html"
	@echo "make test       set up and run the tests; make test-long runs the long ones"
	@echo "make setup      make the environment in .venv (EXTRAS=$(EXTRAS), PYTHON=$(PYTHON))"
	@echo "make lint       style and types"
	@echo "make docs       build the documentation into site/"
	@echo "make revision   write the revision down, for a copy without .git"
	@echo "make paper      make the publication's tables and figures again, and more"
	@echo "                (ARGS='--objects-dir SCANS', needed; ARGS=--list says what there is)"
	@echo "make readme     put the numbers of experiments/results into the READMEs"

setup: $(INSTALLED)

$(INSTALLED): pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	  { echo "$(PYTHON) is older than Python 3.11: make setup PYTHON=python3.12" >&2; exit 1; }
	test -x $(BIN)/python || $(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --disable-pip-version-check \
	  -c constraints.txt -e '.[$(EXTRAS)]'
	touch $@

train: setup
	$(BIN)/python -m mjx_grasp.train $(ARGS)

demo: setup
	$(BIN)/python -m mjx_grasp.demo --instruction "near the top" --out demo $(ARGS)

test: setup
	$(BIN)/python -m pytest $(TEST_FLAGS) $(ARGS)

test-long: setup
	$(BIN)/python -m pytest -m long $(ARGS)

lint: setup
	$(BIN)/ruff check $(SOURCES)
	$(BIN)/ruff format --check $(SOURCES)
	$(BIN)/mypy

format: setup
	$(BIN)/ruff check --fix $(SOURCES)
	$(BIN)/ruff format $(SOURCES)

paper: setup
	$(BIN)/python experiments/paper.py $(ARGS)

docs: setup
	JAX_PLATFORMS=cpu $(BIN)/python docs/build.py site

readme: setup
	$(BIN)/python experiments/make_readme.py

# The revision for a copy without .git, where results say it (mjx_grasp/records/provenance.py).
revision:
	git describe --always --dirty --abbrev=40 --exclude '*' > REVISION

clean:
	rm -rf .venv build dist site *.egg-info .pytest_cache .ruff_cache .mypy_cache .hypothesis
