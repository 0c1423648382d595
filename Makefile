# `make demo` and `make test` do all the set-up; everything lives in $(VENV) and out/.
VENV ?= .venv
BIN := $(VENV)/bin
DEMO := out
# The default Python where it is new enough, else one that is. Override: make PYTHON=...
PYTHON ?= $(shell for p in python3 python python3.11 python3.12 python3.13; do \
	"$$p" -c 'import sys; sys.exit(sys.version_info < (3, 11))' >/dev/null 2>&1 && { echo "$$p"; break; }; done)

.PHONY: help demo test lint site release audit fuzz format bench results schema reference venv clean

help:
	@echo "make demo   simulate, track and evaluate a small scene, with pictures, in $(DEMO)"
	@echo "make test   run the tests"
	@echo "make lint   ruff, mypy and the import contracts"
	@echo "make site   the documentation as a site, in out/site"
	@echo "make release  wheel and sdist in out/dist, checked, installed and used in an empty environment"
	@echo "make audit  known vulnerabilities of the locked versions, where the network answers"
	@echo "make fuzz   damaged files and odd options of every command, for an hour (MINUTES=600), then configurations"
	@echo "make bench  speed benchmarks (minutes)"
	@echo "make results  measure the tables of docs/results anew (15 minutes of CPU time)"
	@echo "make schema write configs/schema.json anew"
	@echo "make reference write docs/reference/configuration/, the index of decisions and the notebooks anew"
	@echo "make clean  remove $(VENV) and out"

demo: $(VENV)/.installed-plot
	$(BIN)/stereophd demo $(DEMO) --force
	@echo "These commands need the environment: . $(BIN)/activate"

test: $(VENV)/.installed-all
	$(BIN)/python -m pytest -n 2 --dist worksteal

lint: $(VENV)/.installed-all
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

site: $(VENV)/.installed-all
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict

release: $(VENV)/.installed-all
	rm -rf out/dist
	$(BIN)/python -m build --outdir out/dist .
	$(BIN)/python -m twine check --strict out/dist/*
	$(BIN)/python .ci/try_wheel.py out/dist

audit: $(BIN)/python
	$(BIN)/python .ci/audit.py .ci/audit

# Damaged files of every format and odd options of every command, then random configurations: make fuzz MINUTES=600
MINUTES ?= 60
EXAMPLES ?= 200
fuzz: $(VENV)/.installed-all
	$(BIN)/python -m tests.fuzz.campaign --minutes $(MINUTES)
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

results: $(VENV)/.installed-all
	$(BIN)/python docs/make_results.py

reference: $(VENV)/.installed-plot
	$(BIN)/python docs/make_configuration.py
	$(BIN)/python docs/make_decisions.py
	$(BIN)/python docs/make_notebooks.py

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
