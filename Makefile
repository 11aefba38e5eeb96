# Two commands on a fresh machine: `make demo` and `make test`. Each sets up all that it needs.
PYTHON ?= python3
VENV ?= .venv
TORCH ?= torch==2.13.0
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed

.PHONY: demo test lint clean

$(STAMP): pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --upgrade pip setuptools -c constraints.txt
	$(BIN)/python -m pip install --quiet -c constraints.txt "$(TORCH)"
	$(BIN)/python -m pip install --quiet -c constraints.txt -e ".[dev]"
	touch $@

demo: $(STAMP)  ## collect on the virtual rig, fit the arm model, compare
	$(BIN)/surgisoft collect grid --points 1728 --seed 1 -o demo/train.parquet --force
	$(BIN)/surgisoft collect validation --seed 1 -o demo/valid.parquet --force
	$(BIN)/surgisoft collect test --seed 1 -o demo/test.parquet --force
	$(BIN)/surgisoft fit demo/train.parquet --valid demo/valid.parquet --effects hysteresis -o demo/model --force
	$(BIN)/surgisoft compare demo/model demo/test.parquet --report demo/compare

test: $(STAMP)  ## the whole suite
	$(BIN)/python -m pytest -n 2 -q

lint: $(STAMP)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

clean:
	rm -rf $(VENV) demo
