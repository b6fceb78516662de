# Two commands do all the set-up: `make demo` and `make test`. Each makes .venv with the pinned dependencies if it is not there.
# On Linux with no CUDA wanted: make demo TORCH_INDEX=https://download.pytorch.org/whl/cpu

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/.ready
TORCH_INDEX ?=
export PIP_DISABLE_PIP_VERSION_CHECK := 1

.PHONY: demo test lint bench soak clean

demo: $(READY)
	@$(BIN)/tgdsl compile examples/xhand1_palm.yaml -o out/xhand1_palm.safetensors
	@$(BIN)/tgdsl run out/xhand1_palm.safetensors --out out

# One process per core, each with one thread of its own: most of the time goes into compiling kernels.
test: $(READY)
	@OMP_NUM_THREADS=1 $(BIN)/python -m pytest --numprocesses auto --dist worksteal

lint: $(READY)
	@$(BIN)/ruff check .
	@$(BIN)/ruff format --check .
	@$(BIN)/pyright

bench: $(READY)
	@$(BIN)/python benchmarks/module.py

# Ten minutes of reading an emulated hand at the highest rate that its line allows; SOAK_SECONDS=60 for one.
SOAK_SECONDS ?= 600
soak: $(READY)
	@$(BIN)/python benchmarks/hand_soak.py --seconds $(SOAK_SECONDS)

clean:
	rm -rf $(VENV) out

$(READY): pyproject.toml constraints.txt
	@$(PYTHON) -m venv $(VENV)
	@$(BIN)/pip install --quiet $(if $(TORCH_INDEX),--index-url $(TORCH_INDEX)) -c constraints.txt torch
	@$(BIN)/pip install --quiet -c constraints.txt -e '.[dev]'
	@touch $(READY)
