# Two commands that do everything on a fresh machine; both may be run again and again, in either order.
PYTHON ?= python3
BIN := .venv/bin
# Without a GPU: the version whose CPU build the package index is known to have.
CONSTRAINTS := $(if $(shell command -v nvidia-smi 2>/dev/null),,-c constraints-cpu.txt)

.PHONY: demo test test-all gate format docs clean

demo: .venv/installed ## environment, install, and the main job on a scene made on the spot
	$(BIN)/viewmend demo --out out/demo

test: gate docs ## environment, install, the gate, the documents, the tests
	$(BIN)/pytest -n auto --dist loadfile

test-all: gate ## the tests that take longer, too
	$(BIN)/pytest -n auto --dist loadfile -m ""

docs: .venv/installed ## the documentation site, in out/site; strict, and nothing is fetched
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet

gate: .venv/installed ## what CI and you run alike
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/pyright
	$(BIN)/lint-imports

format: .venv/installed
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

.venv/installed: pyproject.toml constraints-cpu.txt
	$(PYTHON) -m venv .venv
	$(BIN)/pip install --quiet --disable-pip-version-check $(CONSTRAINTS) --editable '.[docs,dev]'
	touch $@

clean:
	rm -rf .venv out build
