# make demo    environment, full reduction of data_samples/, its result against the truth
# make test    environment, tests
# make help    everything else

PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin

# Wheel index to look at beside the default one, for another build of PyTorch:
#   CPU-only machine   TORCH_INDEX=<URL of PyTorch's index of CPU wheels>   (no CUDA libraries are fetched)
#   CUDA machine       TORCH_INDEX=<URL of PyTorch's index for its CUDA version>
# Left empty, the build comes from the index that pip is configured with.
TORCH_INDEX ?=
PIP_INSTALL = $(BIN)/python -m pip install --quiet -c constraints.txt $(if $(TORCH_INDEX),--extra-index-url $(TORCH_INDEX))

# Inputs of the recipes; data_samples/ is taken for what is not given.
CALIBRATION ?=
RAMP ?=
calibration_input = $(if $(CALIBRATION),--input calibration=$(CALIBRATION))
ramp_input = $(if $(RAMP),--input ramp=$(RAMP))
# Further options, for example ARGS="--set calibrate.method=dip_avg -v"
ARGS ?=
DEMO ?= demo
RUNS ?= runs
# What `make simulate` makes, and where.
SPEC ?= recipes/simulations/on_sky.yaml
OUT ?= $(RUNS)/simulation
# What `make night` reduces, and where the results of all nights are.
NIGHT ?= data_samples
TREE ?= $(RUNS)/nights

.DEFAULT_GOAL := help
.PHONY: help env env-test demo test bench fuzz faults lint clean full calibrate dip-global ramp sensitivity
.PHONY: paper paper-quick paper-tables simulate night diagnose-suite

help: ## list the targets
	@awk -F ':.*## ' '/^[a-z-]+:.*## / {printf "  make %-14s %s\n", $$1, $$2}' $(MAKEFILE_LIST)

env: $(VENV)/.env-run ## create the environment in .venv (PYTHON=..., TORCH_INDEX=...)
env-test: $(VENV)/.env-test ## the same with what the tests need

$(BIN)/python:
	$(PYTHON) -m venv $(VENV)

# The stamps keep the environment from being built again while its description is the same.
$(VENV)/.env-run: pyproject.toml constraints.txt | $(BIN)/python
	$(PIP_INSTALL) --editable .
	@touch $@

$(VENV)/.env-test: pyproject.toml constraints.txt | $(BIN)/python
	$(PIP_INSTALL) --editable '.[dev]'
	@touch $@ $(VENV)/.env-run

demo: env ## full reduction of data_samples/, then its result against the truth
	$(BIN)/irlos run recipes/full_reduction.yaml --output $(DEMO) $(ARGS)
	$(BIN)/irlos score $(DEMO) --truth data_samples/truth

test: env-test ## run the tests, one process per processor
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -q -n auto --maxprocesses 8 $(ARGS)

bench: env-test ## time dip_global against other implementations
	$(BIN)/python -m benchmarks $(ARGS)

diagnose-suite: env-test ## hide every effect in simulated cubes and score diagnose, hours (ARGS="--sample 20 --jobs 2")
	$(BIN)/python -m benchmarks.diagnose_suite --output $(RUNS)/diagnose-suite $(ARGS)

fuzz: env-test ## some thousand damaged and hostile inputs (ARGS="--cases 2000 --seed 1 --jobs 2")
	PYTHONPATH=tests $(BIN)/python -m fuzz $(ARGS)

faults: env-test ## kill runs and fill their disks at random moments (ARGS="--kills 200 --seed 1")
	PYTHONPATH=tests $(BIN)/python -m faults $(ARGS)

lint: env-test ## check the style
	$(BIN)/ruff check .

full: env ## recipes/full_reduction.yaml (CALIBRATION=..., RAMP=...)
	$(BIN)/irlos run recipes/full_reduction.yaml $(calibration_input) $(ramp_input) --output $(RUNS)/full_reduction $(ARGS)

calibrate: env ## recipes/ncpa_calibration.yaml (CALIBRATION=...)
	$(BIN)/irlos run recipes/ncpa_calibration.yaml $(calibration_input) --output $(RUNS)/ncpa_calibration $(ARGS)

dip-global: env ## recipes/ncpa_dip_global.yaml (CALIBRATION=...)
	$(BIN)/irlos run recipes/ncpa_dip_global.yaml $(calibration_input) --output $(RUNS)/ncpa_dip_global $(ARGS)

ramp: env ## recipes/defocus_ramp.yaml (RAMP=..., CALIBRATION=...)
	$(BIN)/irlos run recipes/defocus_ramp.yaml $(ramp_input) $(calibration_input) --output $(RUNS)/defocus_ramp $(ARGS)

sensitivity: env ## recipes/sensitivity.yaml (RAMP=..., CALIBRATION=...)
	$(BIN)/irlos run recipes/sensitivity.yaml $(ramp_input) $(calibration_input) --output $(RUNS)/sensitivity $(ARGS)

paper: env ## every experiment of the paper, hours; stopped, it goes on where it was (ARGS="--only methods")
	$(BIN)/irlos paper --output $(RUNS)/paper $(ARGS)

paper-quick: env ## the same with small samples, minutes
	$(BIN)/irlos paper --output $(RUNS)/paper-quick --quick $(ARGS)

paper-tables: env ## after make paper: its numbers to docs/paper_results.json, and from there into README.md
	cp $(RUNS)/paper/paper_results.json docs/paper_results.json
	$(BIN)/python -m irlos_pipe.paper.run.readme

simulate: env ## recordings with a known truth (SPEC=recipes/simulations/on_sky.yaml, OUT=...)
	$(BIN)/irlos simulate $(SPEC) --output $(OUT) $(ARGS)

night: env ## reduce what is new or out of date in a night or an archive (NIGHT=..., TREE=...)
	$(BIN)/irlos night $(NIGHT) --output $(TREE) $(ARGS)

clean: ## remove what building and testing left (not the environment, not runs/)
	rm -rf build dist demo .pytest_cache .ruff_cache
	find irlos_pipe tests -name __pycache__ -type d -prune -exec rm -rf {} +
	find . -maxdepth 1 -name '*.egg-info' -type d -exec rm -rf {} +
