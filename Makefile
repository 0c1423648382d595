# `make demo` and `make test` do all the set-up; everything lives in $(VENV) and out/.
VENV ?= .venv
BIN := $(VENV)/bin
DEMO := out/quickstart
# The default Python where it is new enough, else one that is. Override: make PYTHON=...
PYTHON ?= $(shell for p in python3 python python3.11 python3.12 python3.13; do \
	"$$p" -c 'import sys; sys.exit(sys.version_info < (3, 11))' >/dev/null 2>&1 && { echo "$$p"; break; }; done)

.PHONY: help demo test lint fuzz format bench schema reference venv clean

help:
	@echo "make demo   simulate, track and evaluate a small scene, with pictures, in $(DEMO)"
	@echo "make test   run the tests"
	@echo "make lint   ruff, mypy and the import contracts"
	@echo "make fuzz   random configurations and damaged files, for hours (EXAMPLES=100000)"
	@echo "make bench  speed benchmarks (minutes)"
	@echo "make schema write configs/schema.json anew"
	@echo "make reference write docs/reference/configuration/ and the index of decisions anew"
	@echo "make clean  remove $(VENV) and out"

demo: $(VENV)/.installed-plot
	$(BIN)/stereophd simulate configs/quickstart.yaml --out $(DEMO)/simulated --force
	$(BIN)/stereophd track configs/quickstart.yaml $(DEMO)/simulated/detections.parquet \
		--cameras $(DEMO)/simulated/cameras.yaml --associations --out $(DEMO)/tracked --force
	$(BIN)/stereophd evaluate $(DEMO)/tracked/tracks.parquet $(DEMO)/simulated/truth.parquet \
		--cutoff 1 --cameras $(DEMO)/simulated/cameras.yaml --out $(DEMO)/evaluated --force
	$(BIN)/stereophd report $(DEMO)/simulated $(DEMO)/tracked $(DEMO)/evaluated --out $(DEMO)/report.html --force
	@echo "Pictures, and the page to open in a browser:"
	@find $(DEMO)/evaluated $(DEMO)/report.html -type f | sort | sed 's/^/  /'

test: $(VENV)/.installed-all
	$(BIN)/python -m pytest -n 2 --dist worksteal

lint: $(VENV)/.installed-all
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

# Random configurations, logs and damaged files, for hours: make fuzz EXAMPLES=100000
EXAMPLES ?= 2000
fuzz: $(VENV)/.installed-all
	STEREOPHD_FUZZ_EXAMPLES=$(EXAMPLES) $(BIN)/python -m pytest tests/fuzz -p no:randomly

format: $(VENV)/.installed-all
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

# Short versions; benchmarks/README.md has the long ones. All run, then it fails if a target was missed.
bench: $(VENV)/.installed-all
	@failed=0; \
	for run in "track_speed.py --repetitions 3" "peers.py --repetitions 1" "single_object.py --repetitions 3" \
		"start_up.py --repetitions 3" "many_objects.py --objects 100 200 --frames 200 --repetitions 1" \
		"long_log.py --detections 200000" "calibrate_speed.py --particles 100 --events 60"; do \
		echo "benchmarks/$$run"; $(BIN)/python benchmarks/$$run || failed=1; echo; \
	done; exit $$failed

reference: $(VENV)/.installed-plot
	$(BIN)/python docs/make_configuration.py
	$(BIN)/python docs/make_decisions.py

schema: $(VENV)/.installed-plot
	schema=$$($(BIN)/stereophd config schema) && printf '%s\n' "$$schema" > configs/schema.json

venv: $(VENV)/.installed-all

$(BIN)/python:
	@test -n "$(PYTHON)" || { echo "stereophd needs Python 3.11 or newer (make PYTHON=/path/to/python)" >&2; exit 1; }
	$(PYTHON) -m venv $(VENV)

$(VENV)/.installed-plot: pyproject.toml constraints.txt | $(BIN)/python
	$(BIN)/python -m pip install --quiet -c constraints.txt -e ".[plot,report]"
	@touch $@

$(VENV)/.installed-all: pyproject.toml constraints.txt | $(BIN)/python
	$(BIN)/python -m pip install --quiet -c constraints.txt -e ".[all]"
	@touch $@ $(VENV)/.installed-plot

clean:
	rm -rf $(VENV) out
