# make press       press a sphere into the BioTac; results in out/press (more choices: make press ARGS="--indenter ring_7mm --depth 1")
# make test        style and the quick tests;  make test-all: the slow ones too
# make benchmarks  accuracy and speed, tables and JSON in out/benchmarks
# make assets      make the meshes in biotac_mj/assets/ again (needs the extra "mesh")
# make clean       remove results and the environment

PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable
ARGS ?=
# a process for each core, each with whole files: what a file sets up is set up once
PYTEST := OMP_NUM_THREADS=1 $(BIN)/python -m pytest --numprocesses auto --dist loadfile

.PHONY: press test test-all benchmarks assets clean

press: $(VENV)/.installed
	$(BIN)/biotac press $(ARGS)

test: $(VENV)/.installed-test
	$(BIN)/ruff check .
	$(PYTEST) $(ARGS)

test-all: $(VENV)/.installed-test
	$(BIN)/ruff check .
	$(PYTEST) -m "slow or not slow" $(ARGS)

benchmarks: $(VENV)/.installed-test
	mkdir -p out/benchmarks
	$(BIN)/python benchmarks/speed.py --device cpu --json out/benchmarks/speed.json $(ARGS)
	if [ -d ../shared/reference ]; then \
	  $(BIN)/python benchmarks/accuracy.py --cases ../shared/reference --json out/benchmarks/accuracy.json; \
	else echo "accuracy left out: its cases are looked for in ../shared/reference"; fi

assets: $(VENV)/.installed-mesh
	$(BIN)/python scripts/make_assets.py $(ARGS)

clean:
	rm -rf out build dist *.egg-info .pytest_cache .ruff_cache $(VENV)

# Each stamp stands for one set of extras, installed once and again when the requirements change.
$(BIN)/python:
	$(PYTHON) -m venv $(VENV)

$(VENV)/.installed: pyproject.toml constraints.txt | $(BIN)/python
	$(PIP) .
	touch $@

$(VENV)/.installed-test: pyproject.toml constraints.txt | $(BIN)/python
	$(PIP) ".[control,batch,learning,data,lerobot,gymnasium,web,test]"
	touch $@ $(VENV)/.installed

$(VENV)/.installed-mesh: pyproject.toml constraints.txt | $(BIN)/python
	$(PIP) ".[mesh]"
	touch $@ $(VENV)/.installed
