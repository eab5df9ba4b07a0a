# make demo    builds the environment, reduces data_samples/ and compares the result with the truth
# make test    builds the environment and runs the tests
# make help    lists everything else

PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin

# The wheel index that PyTorch comes from, and nothing else does, to obtain another build of it:
#   CPU-only machine   TORCH_INDEX=<URL of PyTorch's index of CPU wheels>   (downloads no CUDA libraries)
#   CUDA machine       TORCH_INDEX=<URL of PyTorch's index for its CUDA version>
# If it is empty, the build comes from the index that pip is configured with.
TORCH_INDEX ?=
PIP = $(BIN)/python -m pip install --quiet -c constraints.txt
PIP_INSTALL = $(if $(TORCH_INDEX),$(PIP) --no-deps --index-url $(TORCH_INDEX) torch && )$(PIP)

PYTEST = OMP_NUM_THREADS=1 $(BIN)/python -m pytest -q -n auto --maxprocesses 8 --dist loadgroup

# Inputs of the recipes; ARGS=--samples takes the simulated samples for those that are not given.
CALIBRATION ?=
RAMP ?=
calibration_input = $(if $(CALIBRATION),--input calibration=$(CALIBRATION))
ramp_input = $(if $(RAMP),--input ramp=$(RAMP))
# Further options, for example ARGS="--set calibrate.method=dip_avg -v"
ARGS ?=
DEMO ?= demo
RUNS ?= runs
# The specification and the output folder of `make simulate`.
SPEC ?= on_sky
OUT ?= $(RUNS)/simulation
# The night that `make night` reduces, and the folder with the results of all nights.
NIGHT ?= data_samples
TREE ?= $(RUNS)/nights

# Measured recordings, which are no part of the project; docs/measured.md says where they come from.
MEASURED ?= ../shared/realdata
PHARO = $(MEASURED)/palomar_pharo/ca1.fits
NIRC2 = $(MEASURED)/keck_nirc2/20130801_n0004.fits
BEADS = $(MEASURED)/microscopy_pyotf/psf_wl520nm_z300nm_x130nm_na0.85_n1.0.tif
MIRROR = $(MEASURED)/mirror_bead/dm_poke_actuator1.fits
# $(call where,FILE,COMMAND) runs a command where its file is; exit code 4, a result that needs a look, goes on.
where = if test -f $(1); then $(2) || test $$? -eq 4; fi

.DEFAULT_GOAL := help
.PHONY: help env env-test demo docs test test-quick test-long lint bench fuzz faults misled mistakes clean full calibrate dip-global ramp
.PHONY: tutorial end-to-end foreign focus-demo focus-faults sensitivity paper paper-quick paper-tables simulate night diagnose-suite measured

help: ## list the targets
	@awk -F ':.*## ' '/^[a-z-]+:.*## / {printf "  make %-14s %s\n", $$1, $$2}' $(MAKEFILE_LIST)

env: $(VENV)/.env-run ## create the environment in .venv (PYTHON=..., TORCH_INDEX=...)
env-test: $(VENV)/.env-test ## create the environment with the packages that the tests need

$(BIN)/python:
	$(PYTHON) -m venv $(VENV)

# The stamps prevent rebuilding the environment while its description is unchanged.
$(VENV)/.env-run: pyproject.toml constraints.txt | $(BIN)/python
	$(PIP_INSTALL) --editable '.[paper]'
	@touch $@

$(VENV)/.env-test: pyproject.toml constraints.txt | $(BIN)/python
	$(PIP_INSTALL) --editable '.[dev]'
	@touch $@ $(VENV)/.env-run

$(VENV)/.env-docs: pyproject.toml constraints.txt | $(BIN)/python
	$(PIP_INSTALL) --editable '.[docs]'
	@touch $@

demo: env ## reduce data_samples/ completely and compare the result with the truth
	$(BIN)/irlos demo --output $(DEMO) $(ARGS)

test: env-test ## run the tests, one process per processor; all but those of test-long
	$(PYTEST) $(ARGS)

test-quick: env-test ## run the tests that are not marked slow, in about a minute
	$(PYTEST) -m "not slow and not long and not measured" $(ARGS)

test-long: env-test ## run the tests that take more than half a minute each
	$(PYTEST) -m long $(ARGS)

lint: env-test ## check formatting, style and types
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy

focus-demo: env ## close the focus loop on a simulated telescope for two minutes (ARGS="--speed 0 --no-browser")
	$(BIN)/python -m benchmarks.focus_loop.demo --output $(RUNS)/focus-demo $(ARGS)

tutorial: $(VENV)/.env-docs ## execute the notebook docs/tutorial.ipynb into runs/tutorial.ipynb, about a minute
	mkdir -p $(RUNS)
	cp docs/tutorial.ipynb $(RUNS)/tutorial.ipynb
	$(BIN)/python -m jupyter execute --inplace $(RUNS)/tutorial.ipynb

docs: $(VENV)/.env-docs ## build the documentation site in docs/_build/html; warnings are errors
	$(BIN)/python -m sphinx -q -W --keep-going docs docs/_build/html
	@echo "docs/_build/html/index.html"

bench: env-test ## time the estimators against other implementations
	$(BIN)/python -m benchmarks $(ARGS)

diagnose-suite: env-test ## hide effects in simulated cubes and score diagnose, hours (ARGS="--sample 20 --jobs 2")
	$(BIN)/python -m benchmarks.diagnose_suite --output $(RUNS)/diagnose-suite $(ARGS)

fuzz: env-test ## try some thousand damaged and hostile inputs (ARGS="--cases 2000 --seed 1 --jobs 2")
	PYTHONPATH=tests $(BIN)/python -m fuzz $(ARGS)

misled: env-test ## reduce plausible but wrong inputs, and right ones, and count what misleads (ARGS="--draws 2 --jobs 2")
	$(BIN)/python -m benchmarks.misled --output $(RUNS)/misled $(ARGS)

mistakes: env-test ## make a user's usual mistakes on purpose and count whether the true cause is named (ARGS="--draws 3")
	$(BIN)/python -m benchmarks.mistakes --output $(RUNS)/mistakes $(ARGS)

foreign: env-test ## reduce cubes behind adaptive optics unlike the model's, and judge light and errors (ARGS="--draws 1")
	$(BIN)/python -m benchmarks.foreign --output $(RUNS)/foreign $(ARGS)

focus-faults: env-test ## give the focus loop bad exposures and hours of right ones (ARGS="--only 'light.*' --no-hours")
	$(BIN)/python -m benchmarks.focus_faults --output $(RUNS)/focus-faults $(ARGS)

end-to-end: env-test ## simulate an adaptive optics end to end, half an hour, and reduce what is seen behind it
	$(BIN)/python data_samples/make_end_to_end.py --output $(RUNS)/end_to_end
	@for folder in $(RUNS)/end_to_end/seeing_*; do \
	$(BIN)/irlos run defocus_ramp --input calibration=$$folder/data/calibration --input ramp=$$folder/data/ramp \
		--output $$folder/run $(ARGS); \
	$(BIN)/irlos score $$folder/run --truth $$folder/truth; done

faults: env-test ## kill runs and fill their disks at random moments (ARGS="--kills 200 --seed 1")
	PYTHONPATH=tests $(BIN)/python -m faults $(ARGS)

full: env ## run the recipe full_reduction (CALIBRATION=..., RAMP=...)
	$(BIN)/irlos run full_reduction $(calibration_input) $(ramp_input) --output $(RUNS)/full_reduction $(ARGS)

calibrate: env ## run the recipe ncpa_calibration (CALIBRATION=...)
	$(BIN)/irlos run ncpa_calibration $(calibration_input) --output $(RUNS)/ncpa_calibration $(ARGS)

dip-global: env ## run the recipe ncpa_dip_global (CALIBRATION=...)
	$(BIN)/irlos run ncpa_dip_global $(calibration_input) --output $(RUNS)/ncpa_dip_global $(ARGS)

ramp: env ## run the recipe defocus_ramp (RAMP=..., CALIBRATION=...)
	$(BIN)/irlos run defocus_ramp $(ramp_input) $(calibration_input) --output $(RUNS)/defocus_ramp $(ARGS)

sensitivity: env ## run the recipe sensitivity (RAMP=..., CALIBRATION=...)
	$(BIN)/irlos run sensitivity $(ramp_input) $(calibration_input) --output $(RUNS)/sensitivity $(ARGS)

paper: env ## run every experiment of the paper, hours; resumes if interrupted (ARGS="--only methods")
	$(BIN)/irlos paper --output $(RUNS)/paper $(ARGS)

paper-quick: env ## run every experiment of the paper with small samples, minutes
	$(BIN)/irlos paper --output $(RUNS)/paper-quick --quick $(ARGS)

paper-tables: env ## after make paper: renew docs/paper/ and the tables of docs/results.md (ARGS=--beside)
	$(BIN)/python -m maintenance.paper_tables --take $(RUNS)/paper/tables $(ARGS)

simulate: env ## make recordings with a known truth (SPEC=on_sky, OUT=...)
	$(BIN)/irlos simulate $(SPEC) --output $(OUT) $(ARGS)

night: env ## reduce what is new or out of date in a night or an archive (NIGHT=..., TREE=...)
	$(BIN)/irlos night $(NIGHT) --output $(TREE) $(ARGS)

measured: env ## run recipes/measured/ on the measured recordings that are there (MEASURED=folder)
	@for file in $(PHARO) $(NIRC2) $(BEADS) $(MIRROR); do test -f $$file || missing="$$missing $$file"; done; \
	test -z "$$missing" || echo "make measured: not there:$$missing; docs/measured.md names the sources"
	@$(call where,$(PHARO),$(BIN)/irlos run recipes/measured/pharo.yaml --input cube=$(PHARO) --output $(RUNS)/measured/pharo $(ARGS))
	@$(call where,$(NIRC2),$(BIN)/irlos run recipes/measured/nirc2.yaml --input cube=$(NIRC2) --output $(RUNS)/measured/nirc2 $(ARGS))
	@$(call where,$(BEADS),$(BIN)/python recipes/measured/beads_to_fits.py $(BEADS) $(RUNS)/measured/beads-data)
	@$(call where,$(BEADS),$(BIN)/irlos run recipes/measured/beads.yaml --input ramp=$(RUNS)/measured/beads-data/beads.fits --output $(RUNS)/measured/beads $(ARGS))
	@$(call where,$(MIRROR),$(BIN)/python recipes/measured/mirror_bead_to_fits.py $(MIRROR) $(RUNS)/measured/mirror-data)
	@for volt in 1 2 3 4 5; do $(call where,$(MIRROR),$(BIN)/irlos run recipes/measured/mirror_bead.yaml --input calibration=$(RUNS)/measured/mirror-data/volt_$$volt.fits --output $(RUNS)/measured/mirror_$$volt $(ARGS)); done

clean: ## remove the files that building and testing left (not the environment, not runs/)
	rm -rf build dist demo docs/_build docs/reference .pytest_cache .ruff_cache .mypy_cache
	find irlos_pipe tests -name __pycache__ -type d -prune -exec rm -rf {} +
	find . -maxdepth 1 -name '*.egg-info' -type d -exec rm -rf {} +
