# make demo and make test set up their own virtual environment first; nothing else is needed but Python and make.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
INSTALLED := $(VENV)/.installed

.PHONY: demo test test-all test-view test-install faults stability lint bench docs clean

$(INSTALLED): pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e ".[dev]"
	@touch $@

demo: $(INSTALLED)
	$(BIN)/torchdic demo --out demo --restart

# tests run side by side, each on one thread: a test's tensors are too small for more
test test-all faults: export OMP_NUM_THREADS := 1
# what one process compiles is kept for the others
test test-all faults: export PYTHONDONTWRITEBYTECODE :=
PYTEST := $(BIN)/python -m pytest -n auto --maxprocesses 8 --dist worksteal

test: $(INSTALLED)
	$(PYTEST) -m "not slow"

test-all: $(INSTALLED)
	$(PYTEST)

# what make test leaves out where napari isn't installed
test-view: $(INSTALLED)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e ".[dev,view]"
	$(BIN)/python -m pytest tests/test_view.py tests/test_makers.py

# sdist and wheel, and the wheel in a fresh environment of each of these, away from the checkout
PYTHONS ?= python3.11 python3.12 python3.13

test-install: $(INSTALLED)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt build
	rm -rf dist
	$(BIN)/python -m build --outdir dist
	@set -e; for python in $(PYTHONS); do \
		$$python -m venv --clear dist/venv; \
		dist/venv/bin/python -m pip install --quiet --disable-pip-version-check -c constraints.txt dist/*.whl; \
		( cd dist; set -x; export OMP_NUM_THREADS=1; \
			venv/bin/python --version; \
			venv/bin/python -m torchdic --help > help.txt; \
			venv/bin/python -c "import data_synthetic, recon, torchdic; [open(p.__path__[0] + '/py.typed') for p in (data_synthetic, recon, torchdic)]"; \
			venv/bin/torchdic completion bash > completion.bash; \
			venv/bin/torchdic doctor; \
			venv/bin/torchdic demo --out demo --restart ); \
	done

# disks that fill are small ones of their own: to mount them takes root's rights, or a namespace in which one has them
faults: $(INSTALLED)
	$$(unshare --map-root-user --mount true 2>/dev/null && echo unshare --map-root-user --mount) \
		$(PYTEST) --table -m faults tests/faults

stability: $(INSTALLED)
	$(BIN)/python -m pytest --table tests/test_stability.py tests/test_properties.py

lint: $(INSTALLED)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright

bench: $(INSTALLED)
	$(BIN)/python benchmarks/references.py
	$(BIN)/python benchmarks/exact_fields.py
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e ".[bench]" || \
		echo "the rivals of benchmarks/rays.py can't be installed: reported as missing"
	$(BIN)/python benchmarks/rays.py
	$(BIN)/python benchmarks/threads.py
	OMP_NUM_THREADS=1 $(BIN)/python benchmarks/scaling.py
	OMP_NUM_THREADS=1 $(BIN)/python benchmarks/thin_stack.py
	OMP_NUM_THREADS=1 $(BIN)/python benchmarks/whole.py
	OMP_NUM_THREADS=1 $(BIN)/python benchmarks/transforms.py
	OMP_NUM_THREADS=1 $(BIN)/python benchmarks/planner.py
	OMP_NUM_THREADS=1 $(BIN)/python benchmarks/ranks.py
	$(BIN)/python benchmarks/memory.py
	$(BIN)/python benchmarks/on_gpu.py
	$(BIN)/python benchmarks/performance_figure.py

# warnings are errors: of links, of code blocks, of the gallery's scripts. Nothing is looked up on a network
docs: $(INSTALLED)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e ".[dev,docs]"
	$(BIN)/python -m sphinx -W --keep-going -q -b html docs docs/_build/html
	@echo "docs/_build/html/index.html"

clean:
	rm -rf docs/_build docs/generated docs/gallery
	rm -rf $(VENV) demo dist .pytest_cache .ruff_cache
