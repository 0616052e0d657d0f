# Two commands do everything on a fresh machine: `make demo` and `make test`.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed

.PHONY: install demo test lint bench tables docs clean

install: $(STAMP)

$(STAMP): pyproject.toml constraints.txt
	$(PYTHON) -c 'import sys; sys.exit(0 if sys.version_info >= (3, 11) else "dyntorch needs Python 3.11 or newer; try: make PYTHON=python3.12 ...")'
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable '.[dev]'
	touch $(STAMP)

demo: install
	$(BIN)/dyntorch demo --out demo-report

# one worker per core, one thread each: two minutes instead of six on two cores
test: install
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n auto

lint: install
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

bench: install
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable '.[experiments]'
	$(BIN)/python -m experiments.benchmarks.null_space
	$(BIN)/python -m experiments.benchmarks.fits
	$(BIN)/python -m experiments.benchmarks.robust_peers
	$(BIN)/python -m experiments.benchmarks.lifted
	$(BIN)/python -m experiments.benchmarks.segmentation
	$(BIN)/python -m experiments.benchmarks.synchronization
	$(BIN)/python -m experiments.benchmarks.action_indexer
	$(BIN)/python -m experiments.benchmarks.brightness_indexer

tables: install
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable '.[experiments]'
	$(BIN)/python -m experiments.homography_tensor_noise
	$(BIN)/python -m experiments.tensor_noise_3d
	$(BIN)/python -m experiments.robust_estimation
	$(BIN)/python -m experiments.lifted_noise
	$(BIN)/python -m experiments.lifted_outliers
	$(BIN)/python -m experiments.trajectories
	$(BIN)/python -m experiments.segmentation_matrix_noise
	$(BIN)/python -m experiments.translating_planes
	$(BIN)/python -m experiments.segmentation
	$(BIN)/python -m experiments.segmentation_sensitivity
	$(BIN)/python -m experiments.synchronization
	$(BIN)/python -m experiments.brightness_synchronization
	$(BIN)/python -m experiments.pair_reconstruction
	$(BIN)/python -m experiments.real_lifted
	$(BIN)/python -m experiments.real_planar
	$(BIN)/python -m experiments.real_synchronization
	$(BIN)/python -m experiments.real_space
	$(BIN)/python -m experiments.action_recognition
	$(BIN)/python -m experiments.action_baselines
	$(BIN)/python -m experiments.dynamic_shape
	$(BIN)/python -m experiments.recognition_protocol
	$(BIN)/python -m experiments.open_set
	$(BIN)/python -m experiments.detection
	$(BIN)/python -m experiments.robustness
	$(BIN)/python -m experiments.gait
	$(BIN)/python -m experiments.brightness_indexing
	$(BIN)/python -m experiments.gestures

docs: install
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable '.[docs]'
	$(BIN)/pdoc --math --output-directory site dyntorch indexing

clean:
	rm -rf $(VENV) site build dist demo-report results
