# Two commands do all the set-up: `make demo` and `make test`. Each makes .venv with the pinned dependencies if it is not there.
# On Linux with no CUDA wanted: make demo TORCH_INDEX=https://download.pytorch.org/whl/cpu

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/.ready
TORCH_INDEX ?=
PIP = $(BIN)/pip install $$([ -t 2 ] || echo --quiet)
export PIP_DISABLE_PIP_VERSION_CHECK := 1
VERSION = $(shell sed -n 's/^version = "\(.*\)"/\1/p' pyproject.toml)

ADAPTERS := .venv-adapters

.PHONY: demo learn test test-full test-adapters test-resolve mutate lint bench docs soak clean

demo: $(READY)
	@echo "compiling examples/xhand1_palm.yaml"
	@$(BIN)/tgdsl compile examples/xhand1_palm.yaml -o out/xhand1_palm.safetensors
	@echo "stepping its scene: the hand squeezes a cube"
	@$(BIN)/tgdsl run out/xhand1_palm.safetensors --out out

# Ten minutes in which a finger learns to find a ridge by touch: see docs/start/learn.md. `make learn MINUTES=1` takes one; LEARN="--blind".
MINUTES ?= 10
learn: $(READY)
	@OMP_NUM_THREADS=1 $(BIN)/python examples/learn.py --minutes $(MINUTES) $(LEARN)

# One process per core, each with one thread. Bytecode is kept, or every process compiles tgdsl and the tests again: 13 s for each worker.
PYTEST = OMP_NUM_THREADS=1 PYTHONDONTWRITEBYTECODE= $(BIN)/python -m pytest --numprocesses auto --dist worksteal

# Every property once, in ten minutes on two cores.
test: $(READY)
	@$(PYTEST) -m "not slow"

# The rest: oracles, each kind compiled by itself, learning, the physics of tasks, the wheel; and calls with their types and
# shapes checked. Kernels run in processes that check no types.
test-full: $(READY)
	@OMP_NUM_THREADS=1 $(BIN)/python -m pytest -m browser
	@$(PYTEST) -m "slow and not browser"
	@$(PYTEST) -m "not slow" --check-types -k "not kernel and (not sensors or float32_equals_reference)" tests/geometry tests/observations tests/quantities tests/surfaces tests/tensors tests/sensors

# Adapters against the simulators as they are installed, each in an environment of its own beside torch and the rest of $(VENV). mjlab
# pins MuJoCo 3.11, with which readers and errors are tested too; lerobot reads datasets back; one that cannot be installed is named.
# mjlab_newest is mjlab with the newest MuJoCo that tgdsl takes, that of $(VENV).
test-adapters: test-resolve adapter-mjlab adapter-mjlab_newest adapter-newton adapter-gymnasium_robotics adapter-lerobot
PINS = cat tests/adapters/constraints-$*.txt
adapter-mjlab_newest: PINS = grep -v ^mujoco tests/adapters/constraints-mjlab.txt
adapter-mjlab: MORE = tests/runtime/test_by_name.py tests/runtime/batch/test_older_mujoco.py
adapter-%: $(READY)
	@$(PYTHON) -m venv $(ADAPTERS)/$*
	@$(PINS) > $(ADAPTERS)/$*/pins.txt
	@if $(ADAPTERS)/$*/bin/pip install --quiet --no-deps -r $(ADAPTERS)/$*/pins.txt; then \
		$(BIN)/python -c "import sysconfig; print(sysconfig.get_path('purelib'))" \
			> $$($(ADAPTERS)/$*/bin/python -c "import sysconfig; print(sysconfig.get_path('purelib'))")/tgdsl.pth && \
		OMP_NUM_THREADS=1 $(ADAPTERS)/$*/bin/python -m pytest -W default tests/adapters $(MORE); \
	else echo "$* cannot be installed here: its adapter is not tested"; fi

# Versions that suit both tgdsl and mjlab, in an empty environment; nothing is installed.
test-resolve:
	@$(PYTHON) -m venv $(ADAPTERS)/empty
	@if $(ADAPTERS)/empty/bin/pip install --quiet --dry-run . mjlab 2> $(ADAPTERS)/empty/errors.txt; then \
		echo "tgdsl and mjlab can be installed together"; \
	elif grep -q ResolutionImpossible $(ADAPTERS)/empty/errors.txt; then cat $(ADAPTERS)/empty/errors.txt; exit 1; \
	else echo "no packages can be had here: tgdsl and mjlab together are not tried"; fi

# Change one thing at a time in a room and list what no test notices: make mutate ROOM=sensors MUTATE="--count 60".
ROOM ?= fields
mutate: $(READY)
	@$(BIN)/python tests/mutate.py $(ROOM) $(MUTATE)

lint: $(READY)
	@$(BIN)/ruff check .
	@$(BIN)/ruff format --check .
	@$(BIN)/pyright

bench: $(READY)
	@$(BIN)/python benchmarks/module.py

# These pages and the reference that is generated from the code, as HTML: open build/docs/index.html. A warning is an error.
# Each version has its folder there, which stays until `make clean`; the sidebar switches between them.
docs: $(READY)
	@$(BIN)/python -m sphinx -b html -W --keep-going --quiet docs build/docs/$(VERSION)
	@$(BIN)/python docs/_ext/tgdsl_docs/versions.py build/docs
	@echo "build/docs/index.html"

# Ten minutes of reading an emulated hand at the highest rate that its line allows; SOAK_SECONDS=60 for one.
SOAK_SECONDS ?= 600
soak: $(READY)
	@$(BIN)/python benchmarks/hand_soak.py --seconds $(SOAK_SECONDS)

clean:
	rm -rf $(VENV) $(ADAPTERS) out build docs/generated

# On a terminal pip shows what it downloads: torch alone may take minutes.
$(READY): pyproject.toml constraints.txt
	@echo "making $(VENV) with $$($(PYTHON) --version)"
	@$(PYTHON) -m venv $(VENV)
	@echo "installing torch$(if $(TORCH_INDEX), from $(TORCH_INDEX)): the largest part, once"
	@$(PIP) $(if $(TORCH_INDEX),--index-url $(TORCH_INDEX)) -c constraints.txt torch
	@echo "installing tgdsl and all else that its examples and tests need"
	@$(PIP) -c constraints.txt -e '.[dev,docs]'
	@touch $(READY)
	@echo "$(VENV) is ready"
