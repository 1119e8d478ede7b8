PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
ALGO ?= cpo
ENV ?= Goal_Point_8Hazards
STEPS ?= 1000000
# What CPO keeps there within these steps; hyperparams/*.yml have the others.
LIMIT ?= $(if $(filter cpo_Goal_Point_8Hazards,$(ALGO)_$(ENV)),5)
ARGS ?=

.PHONY: train test test-slow test-lowest check format type docs docs-browser gallery bench fingerprint clean

# torch goes first and alone: a requirement that another package leaves open would fetch CUDA builds
$(VENV)/ready: pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --constraint constraints.txt torch
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable ".[dev]"
	touch $@

train: $(VENV)/ready
	$(BIN)/python -m sb3_guard.train --algo $(ALGO) --env $(ENV) -n $(STEPS) --progress \
		$(if $(LIMIT),-params cost_limit:$(LIMIT)) $(ARGS)

test: $(VENV)/ready
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n 2 -m "not slow" $(ARGS)

test-slow: $(VENV)/docs-ready
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n 2 -m slow $(ARGS)

# The same tests with the oldest dependencies that pyproject.toml admits; torch stays pinned.
test-lowest: $(VENV)/ready
	$(BIN)/python scripts/lowest_versions.py > $(VENV)/lowest.txt
	$(PYTHON) -m venv $(VENV)-lowest
	$(VENV)-lowest/bin/python -m pip install --quiet --constraint $(VENV)/lowest.txt torch
	$(VENV)-lowest/bin/python -m pip install --quiet --constraint $(VENV)/lowest.txt --editable ".[dev]"
	OMP_NUM_THREADS=1 $(VENV)-lowest/bin/python -m pytest -n 2 -m "not slow" $(ARGS)

check: $(VENV)/ready
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

format: $(VENV)/ready
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

type: $(VENV)/ready
	$(BIN)/mypy

bench: $(VENV)/ready
	$(BIN)/python scripts/bench_engine.py
	$(BIN)/python scripts/bench_training.py

# Hashes of what environments and algorithms compute; ARGS="cpo sac_lag" for some of them.
fingerprint: $(VENV)/ready
	@$(BIN)/python scripts/fingerprint.py $(ARGS)

$(VENV)/docs-ready: $(VENV)/ready
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable ".[docs]"
	touch $@

# The generated pages, then the site, docs/_build/html/index.html; a warning is an error.
docs: $(VENV)/docs-ready
	$(BIN)/python scripts/make_docs.py
	$(BIN)/python -m sphinx -W --keep-going -q docs docs/_build/html
	@if command -v npm > /dev/null; then $(MAKE) docs-browser; else \
		echo "npm is not installed: the page in which agents drive is left out"; fi

# Agents that drive in a page, docs/_build/html/browser. npm fetches MuJoCo for browsers.
docs-browser: $(VENV)/ready
	$(BIN)/python scripts/make_browser.py

# The pictures of the pages, which need a display or EGL.
gallery: $(VENV)/ready
	$(BIN)/python scripts/render_gallery.py

clean:
	rm -rf $(VENV) $(VENV)-lowest build dist .pytest_cache .mypy_cache .ruff_cache
