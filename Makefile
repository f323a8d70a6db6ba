# Two commands that do everything on a fresh machine; both may be run again and again, in either order.
PYTHON ?= python3
BIN := .venv/bin
# Without a GPU: the version whose CPU build the package index is known to have.
CONSTRAINTS := $(if $(shell command -v nvidia-smi 2>/dev/null),,-c constraints-cpu.txt)
# Static checks, documents and tests run next to each other.
MAKEFLAGS += --jobs=4
# Several processes read the same files, so the first one that compiles a file does so for all.
unexport PYTHONDONTWRITEBYTECODE
PYTEST := $(BIN)/pytest -n auto --dist worksteal
# Without the checks: JAXTYPING_DISABLE alone would still wrap every function.
UNCHECKED := JAXTYPING_DISABLE=1 $(PYTEST) --jaxtyping-packages=
# Array shapes are checked in every call: by `make test` in these tests, which `shapes` runs and `tests` leaves out,
# and by `make test-all` in all of them.
CHECKED := tests/laws tests/test_types.py tests/test_stream.py tests/geometry/test_cameras.py \
	tests/rendering/test_view.py tests/models/test_attention.py tests/data/test_prepare.py \
	tests/training/test_adversarial.py tests/evaluation/test_scores.py tests/metrics/test_image_quality.py \
	tests/preprocess/test_corners.py tests/live/test_encoding.py tests/export/scene
KERNELS := $(shell find src -name '_*_numba.py')

.PHONY: demo pictures performance site test test-all tests slow shapes kernels gate types docs format clean

demo: .venv/installed ## environment, install, and the main job on a scene made on the spot
	$(BIN)/viewmend demo --out out/demo

test: gate types docs tests shapes ## environment, install, static checks, the documents, the tests

test-all: gate types docs kernels ## slow tests, too, and the shapes of arrays in every call
	$(PYTEST) -m ""

tests: kernels
	$(UNCHECKED) $(CHECKED:%=--ignore=%) $(OPTIONS)

slow: kernels ## tests over five seconds, and those in a browser
	$(UNCHECKED) -m slow $(OPTIONS)

shapes: kernels
	$(BIN)/pytest $(CHECKED)

kernels: out/kernels ## compiled once, not by each worker

out/kernels: .venv/installed $(KERNELS)
	$(BIN)/python tests/compile_kernels.py
	mkdir -p out
	touch $@

docs: .venv/installed ## the documentation site, in out/site; strict, and nothing is fetched
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet

pictures: .venv/installed ## the pictures of the README and the documents, as the package draws them now
	$(BIN)/python research/make_pictures.py

performance: .venv/installed ## the synthetic performer on the front page of the site, below 5 MB
	$(BIN)/viewmend publish studio out/performance --max-mb 4.9 --completed-cameras 12

site: performance ## the documentation site with the performance
	$(MAKE) docs

gate: .venv/installed
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/lint-imports

types: .venv/installed
	$(BIN)/pyrefly check

format: .venv/installed
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

.venv/installed: pyproject.toml constraints-cpu.txt
	$(PYTHON) -m venv .venv
	$(BIN)/pip install --quiet --disable-pip-version-check $(CONSTRAINTS) --editable '.[docs,dev]'
	touch $@

clean:
	rm -rf .venv out build
