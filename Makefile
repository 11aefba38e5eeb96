# Commands on a fresh machine. Each target sets up all that it needs.
PYTHON ?= python3
VENV ?= .venv
TORCH ?= torch==2.13.0
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
DOCS_STAMP := $(VENV)/.installed-docs

# Newer versions of setuptools warn in a box of folders that have the name of an editable package.
EDITABLE := "ignore:Editable installation"

# Without bytecode each process that a test starts, and each of pytest's workers, compiles all modules.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: demo test fast coverage lint docs fuzz mutants kills sbom tutorials clean

ifdef LOCKED  # `make LOCKED=1 ...`: only files whose SHA-256 is in requirements.lock, and the torch that is named
$(STAMP): pyproject.toml requirements.lock
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --no-deps "$(TORCH)"
	$(BIN)/python -m pip install --quiet --require-hashes --no-deps -r requirements.lock
	PYTHONWARNINGS=$(EDITABLE) $(BIN)/python -m pip install --quiet --no-deps --no-build-isolation -e .
	touch $@

$(DOCS_STAMP): $(STAMP)
	touch $@
else
$(STAMP): pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --upgrade pip setuptools -c constraints.txt
	$(BIN)/python -m pip install --quiet -c constraints.txt "$(TORCH)"
	PYTHONWARNINGS=$(EDITABLE) $(BIN)/python -m pip install --quiet -c constraints.txt -e ".[dev]"
	touch $@

$(DOCS_STAMP): $(STAMP)
	PYTHONWARNINGS=$(EDITABLE) $(BIN)/python -m pip install --quiet -c constraints.txt -e ".[docs]"
	touch $@
endif

demo: $(STAMP)  ## train two arms to cut a ring, replay it; find the effect that a model is missing
	rm -rf demo/ring
	$(BIN)/surgisoft train --task circle_ablation --preset robust --minutes 4 -o demo/ring
	$(BIN)/surgisoft evaluate demo/ring scripted random --task circle_ablation --episodes 4 --replay demo/ring.rrd
	$(BIN)/surgisoft evaluate demo/ring scripted --on rig --episodes 2
	$(BIN)/surgisoft collect mixed --seed 0 --hidden creep -o demo/bench.parquet --force
	$(BIN)/surgisoft compare default demo/bench.parquet --report demo/compare
	$(BIN)/surgisoft diagnose default demo/bench.parquet --report demo/diagnosis
	$(BIN)/surgisoft amend default --effect creep --data demo/bench.parquet -o demo/amended --force
	@echo "Look at demo/compare/report.html and demo/diagnosis/diagnosis.html;"
	@echo "see the cut with: $(BIN)/surgisoft replay demo/ring-ring.rrd --web"
	@echo "Lines with 'next: surgisoft ...' above run as $(BIN)/surgisoft ..., or after: source $(BIN)/activate"

test: $(STAMP)  ## the whole suite
	$(BIN)/python -m pytest -n 2 -q

fast: $(STAMP)  ## the tests that are not marked slow
	$(BIN)/python -m pytest -n 2 -q -m fast

coverage: $(STAMP)  ## branches that the suite takes, by part, as docs/results/coverage.md
	rm -rf .coverage && mkdir .coverage
	$(BIN)/python -m coverage run -m pytest -n 2 -q
	$(BIN)/python -m coverage combine --quiet
	$(BIN)/python -m benchmarks.coverage_table > docs/results/coverage.md

lint: $(STAMP)  ## style, format, types
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

SECONDS ?= 300
fuzz: $(STAMP)  ## mutated files into every reader for SECONDS
	$(BIN)/python -m benchmarks.fuzz --seconds $(SECONDS) --workers 2

mutants: $(STAMP)  ## wrong versions of the source that the tests should notice
	$(BIN)/python -m benchmarks.mutants

kills: $(STAMP)  ## commands ended by SIGKILL at any moment
	$(BIN)/python -m benchmarks.kills

sbom: $(STAMP)  ## what is installed, as sbom.json (CycloneDX)
	$(PYTHON) -m venv $(VENV)/sbom
	$(VENV)/sbom/bin/pip install --quiet "cyclonedx-bom>=7.5,<8"
	$(VENV)/sbom/bin/cyclonedx-py environment $(BIN)/python --pyproject pyproject.toml --of JSON -o sbom.json

docs: $(DOCS_STAMP)  ## the documentation site, in site/
	$(BIN)/python docs/draw_architecture.py --check
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet
	@echo "Read it with: $(BIN)/python -m http.server --directory site"

tutorials: $(STAMP)  ## run every block of code of the tutorials, and the guides' Python
	$(BIN)/python docs/run_tutorials.py

clean:
	rm -rf $(VENV) demo site
