# make press       press a sphere into the BioTac; results in out/press (more choices: make press ARGS="--indenter ring_7mm --depth 1mm")
# make test        style and the quick tests;  make test-all: the slow ones too
# make test-wheel  what CI runs: the same as test, of the wheel as a user has it, and not of this folder
# make test-newest the tests that touch MuJoCo, on the newest one, which dm_control does not go with; of the package that pip makes
# make test-neighbours  the pages and tests that need JAX or mjlab
# make docs        the site, in docs/_build/html: warnings and broken links are errors
# make benchmarks  accuracy and speed, tables and JSON in out/benchmarks
# make assets      make the meshes in biotac_mj/assets/ again (needs the extra "mesh")
# make clean       remove results and the environment

PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
NEWEST := $(VENV)-newest
NEIGHBOURS := $(VENV)-neighbours
# modules are compiled as they are first imported: all of them would take as long as the rest of the set-up
PIP := -m pip install --quiet --no-compile --disable-pip-version-check --constraint constraints.txt
ARGS ?=
# a process for each core, each with whole files: what a file sets up is set up once
PYTEST := pytest --numprocesses auto --dist loadfile --no-loadscope-reorder
ON_MUJOCO := $(addprefix tests/test_,package.py plugin.py attach.py coupling.py coupling_fem.py coupling_schemes.py batch.py press.py scenes.py errors.py)
# of what is installed: nothing of this folder is imported, neither by the tests nor by processes that they start
INSTALLED := PYTHONSAFEPATH=1 BIOTAC_TEST_INSTALLED=1
OF_INSTALLED := $(PYTEST) --override-ini pythonpath=
test test-all test-wheel test-newest test-neighbours: export OMP_NUM_THREADS := 1
# modules are compiled once, and not in each process again: 8 s for what the tests import of this folder alone, 20 s and more in a
# fresh environment
unexport PYTHONDONTWRITEBYTECODE

.PHONY: press test test-all test-wheel test-newest test-neighbours docs benchmarks assets clean

press: $(VENV)/.installed
	@echo "a press takes 10 s of processor time; the first on a machine 45 s, its kernels are compiled"
	$(BIN)/biotac press $(ARGS)

test: $(VENV)/.installed-test
	$(BIN)/ruff check .
	$(BIN)/python -m $(PYTEST) $(ARGS)

test-all: $(VENV)/.installed-test
	$(BIN)/ruff check .
	$(BIN)/python -m $(PYTEST) -m "slow or not slow" $(ARGS)

# without the stamps what needs this folder installs it again
test-wheel: $(VENV)/.installed-test
	$(BIN)/ruff check .
	rm -rf build dist $(VENV)/.installed*
	$(BIN)/python -m pip wheel --quiet --no-deps --wheel-dir dist .
	$(BIN)/python $(PIP) --force-reinstall --no-deps dist/*.whl
	$(INSTALLED) $(BIN)/$(OF_INSTALLED) $(ARGS)

test-newest: $(NEWEST)/.installed
	rm -rf build
	$(NEWEST)/bin/python $(PIP) --force-reinstall --no-deps .
	$(INSTALLED) $(NEWEST)/bin/$(OF_INSTALLED) $(ARGS) $(wildcard $(ON_MUJOCO))

test-neighbours: $(NEIGHBOURS)/.installed
	$(NEIGHBOURS)/bin/python -m $(PYTEST) -m "slow or not slow" $(ARGS) tests/test_mjx.py tests/test_differentiable_jax.py \
	  tests/test_documents.py -k "jax or mjx or mjlab or gradients.md"

docs: $(VENV)/.installed-docs
	$(BIN)/python scripts/api.py
	$(BIN)/python -m sphinx --fail-on-warning --keep-going docs docs/_build/html

benchmarks: $(VENV)/.installed-test
	mkdir -p out/benchmarks
	$(BIN)/python benchmarks/speed.py --device cpu --json out/benchmarks/speed.json $(ARGS)
	if [ -d ../shared/reference ]; then \
	  $(BIN)/python benchmarks/accuracy.py --cases ../shared/reference --json out/benchmarks/accuracy.json; \
	else echo "accuracy left out: its cases are looked for in ../shared/reference"; fi

assets: $(VENV)/.installed-mesh
	$(BIN)/python scripts/make_assets.py $(ARGS)

clean:
	rm -rf out build dist docs/_build *.egg-info .pytest_cache .ruff_cache $(VENV) $(NEWEST) $(NEIGHBOURS)

# Each stamp stands for one set of extras, installed once and again when the requirements change.
$(BIN)/python:
	$(PYTHON) -m venv $(VENV)

$(VENV)/.installed: pyproject.toml constraints.txt | $(BIN)/python
	@echo "installing into $(VENV), once: 25 s of processor time, and the time to download 0.5 GB"
	$(BIN)/python $(PIP) --editable .
	touch $@

# mujoco_warp as old as the MuJoCo that dm_control goes with; the newest of both are test-newest's
$(VENV)/.installed-test: pyproject.toml constraints.txt | $(BIN)/python
	$(BIN)/python $(PIP) --editable ".[control,batch,learning,data,lerobot,gymnasium,web,ros,test]" "mujoco-warp<4"
	touch $@ $(VENV)/.installed

$(VENV)/.installed-mesh: pyproject.toml constraints.txt | $(BIN)/python
	$(BIN)/python $(PIP) --editable ".[mesh]"
	touch $@ $(VENV)/.installed

$(VENV)/.installed-docs: pyproject.toml constraints.txt | $(BIN)/python
	$(BIN)/python $(PIP) --editable ".[control,batch,learning,gymnasium,docs]"
	touch $@ $(VENV)/.installed

$(NEWEST)/.installed: pyproject.toml constraints.txt
	$(PYTHON) -m venv $(NEWEST)
	$(NEWEST)/bin/python $(PIP) ".[batch,data,web,test]"
	touch $@

# mjlab asks for another MuJoCo, so it comes without what it asks for
$(NEIGHBOURS)/.installed: pyproject.toml constraints.txt
	$(PYTHON) -m venv $(NEIGHBOURS)
	$(NEIGHBOURS)/bin/python $(PIP) --editable ".[batch,learning,mjx,test]" "mujoco<4" "mujoco-warp<4" imageio-ffmpeg mediapy prettytable tyro
	$(NEIGHBOURS)/bin/python $(PIP) --no-deps mjlab
	touch $@
