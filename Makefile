# Two commands do everything on a fresh machine: `make demo` and `make test`.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
# The CPU build of torch is 190 MB; on Linux the usual one brings CUDA along, 2.5 GB with its fifteen packages.  Where no GPU is seen
# the CPU build is taken if pip finds one.  TORCH_INDEX: the package index that PyTorch's "Get Started" page names for pip and CPU.
TORCH ?= $(if $(shell command -v nvidia-smi 2>/dev/null),gpu,cpu)
TORCH_INDEX ?=
TORCH_VERSION := $(shell sed -n 's/^torch==//p' constraints.txt)
PIP = $(BIN)/python -m pip install --quiet

# what computes, apart from reading, drawing and the command line
NUMERICAL := tests/dyntorch tests/battery tests/test_readme.py tests/indexing/action tests/indexing/archive tests/indexing/brightness tests/indexing/phase tests/indexing/recordings tests/indexing/sync \
  tests/indexing/test_estimator.py dyntorch

.PHONY: install demo test test-slow test-all portable lint bench fuzz tables docs clean

install: $(STAMP)

$(STAMP): pyproject.toml constraints.txt hatch_build.py $(wildcard dyntorch/native/*.[ch])
	@$(PYTHON) -c 'import sys; sys.exit(0 if sys.version_info >= (3, 11) else "dyntorch needs Python 3.11 or newer; try: make PYTHON=python3.12 ...")'
	@test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
ifeq ($(TORCH)-$(shell uname -s),cpu-Linux)
	@echo "Looking for torch without CUDA (190 MB) ..."
	@$(PIP) --retries 1 --timeout 20 --no-deps $(if $(TORCH_INDEX),--index-url $(TORCH_INDEX)) 'torch==$(TORCH_VERSION)+cpu' 2>$(VENV)/torch.log \
	  || { tail -n 1 $(VENV)/torch.log; echo 'pip finds none here: it takes torch with CUDA (2.5 GB). To avoid that, stop, and give the index that the' \
	  '"Get Started" page of PyTorch names for pip and CPU: make install TORCH_INDEX=...'; }
endif
	@echo "Installing dyntorch and its packages into $(VENV): about a minute in which pip says nothing, longer if much is to be fetched ..."
	@$(PIP) --constraint constraints.txt --editable '.[dev]'
	@touch $(STAMP)
	@echo "Installed: $$($(BIN)/dyntorch --version)."

demo: install
	@echo "The demo takes 10 to 20 seconds."
	$(BIN)/dyntorch demo --out demo-report

# one worker per core, one thread each
test: install
	@echo "The fast tests: under four minutes on two quiet cores.  Everything, a quarter of an hour: make test-all"
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n auto -m "not slow"

test-slow: install
	@echo "The slow tests: about eight minutes on two quiet cores."
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n auto -m slow

test-all: test test-slow

# the fast numerical tests without the kernel and with the arithmetic of another processor, then with two threads in each worker and the
# kernel for the oldest processors
portable: install
	DYNTORCH_NATIVE=0 ATEN_CPU_CAPABILITY=default MKL_ENABLE_INSTRUCTIONS=SSE4_2 MKL_CBWR=COMPATIBLE OMP_NUM_THREADS=1 \
	  $(BIN)/python -m pytest -n auto -m "not slow" $(NUMERICAL)
	DYNTORCH_NATIVE=base OMP_NUM_THREADS=2 $(BIN)/python -m pytest -n auto -m "not slow" $(NUMERICAL)

lint: install
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

# every format's files, mutated, through every reader: a long run with a table of outcomes
fuzz: install
	$(BIN)/python -m tests.fuzz --files 100000 --commands 2000

bench: install
	@echo "All benchmarks: about half an hour on quiet cores, longer on busy ones; each says what it does and prints its table as it ends."
	$(PIP) --constraint constraints.txt --editable '.[experiments,cluster]'
	$(BIN)/python -m experiments.common.results benchmarks

tables: install
	@echo "All tables: hours.  Each page of docs/results names its command, which prints the table and writes it into the page."
	$(PIP) --constraint constraints.txt --editable '.[experiments]'
	$(BIN)/python -m experiments.common.results

docs: install
	@echo "The documentation: one to three minutes, in which the examples of the gallery run; then open site/index.html."
	$(PIP) --constraint constraints.txt --editable '.[docs,video]'
	$(BIN)/python -m sphinx -q -E -W --keep-going -b html docs site

clean:
	rm -rf $(VENV) site docs/api docs/auto_gallery build dist demo-report results
