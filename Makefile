# `make demo` and `make test` are all that a newcomer needs; both set up what they use.
# Another Python has a virtual environment of its own: make test PYTHON=python3.13
# So has another release of bpy, on which only the tests of Blender run: make test PYTHON=python3.13 BPY=5.3.0

find_python = $(shell for name in $(1); do \
	"$$name" -c 'import sys; print(sys.executable)' 2>/dev/null && break; \
	release=$$(pyenv latest "$$(expr "$$name" : "python\(.*\)")" 2>/dev/null) && PYENV_VERSION="$$release" pyenv which "$$name" 2>/dev/null && break; \
	done)

PYTHON ?= python3.11 python3.13 python3
INTERPRETER := $(call find_python,$(PYTHON))
VERSION := $(shell "$(INTERPRETER)" -c 'import sys; print("%d.%d" % sys.version_info[:2])' 2>/dev/null)
VENV := $(if $(filter 3.11,$(VERSION)),.venv,.venv-$(VERSION))$(if $(BPY),-bpy$(BPY))
PY := $(VENV)/bin/python
TYPED := -p snerg.core -p snerg.operators -p snerg.snerg_addon

.PHONY: setup parts demo bench-train bench-estimate bench-presets bench-page bench-grid bench-viewport proof fuzz mutation hard-cases test test-slow test-blender lint format extension release docs pictures clean python

# Python's packages and the web viewer at the same time, once it is known that Python will do.
setup: python
	@+$(MAKE) --no-print-directory --jobs=2 parts

parts: $(VENV)/.installed build/viewer.stamp
	@:

python:
	@case "$(VERSION)" in \
	  3.11|3.13) ;; \
	  "") echo "No Python called '$(PYTHON)' runs here; install Python 3.11 or 3.13, or name one: make $(MAKECMDGOALS) PYTHON=/path/to/python" >&2; exit 2;; \
	  *) echo "Python $(VERSION) will not do: Blender comes as a module for 3.11 and 3.13; make $(MAKECMDGOALS) PYTHON=/path/to/python" >&2; exit 2;; \
	esac

$(VENV)/.installed: requirements.txt pyproject.toml | python
	test -x $(PY) || "$(INTERPRETER)" -m venv $(VENV) || { rm -rf $(VENV); echo "This Python cannot make virtual environments; install its venv module." >&2; exit 2; }
	sed '$(if $(BPY),s/^bpy==.*/bpy==$(BPY)/)' requirements.txt > $(VENV)/requirements.txt
	$(PY) -m pip install --disable-pip-version-check -q --no-compile -r $(VENV)/requirements.txt # what is imported is compiled then
	$(PY) -m pip install --disable-pip-version-check -q --no-deps --no-build-isolation -e .
	touch $@

node_modules/.installed: package.json package-lock.json viewer/package.json
	@command -v npm >/dev/null || { echo "The web viewer is built with npm; install Node 20 or newer." >&2; exit 2; }
	npm ci --no-audit --no-fund --loglevel=error
	touch $@

build/viewer.stamp: node_modules/.installed $(shell find viewer -type f -not -path '*/dist/*' 2>/dev/null)
	npm run --silent build
	mkdir -p build && touch $@

demo: setup
	$(PY) demo/run.py

# DATA=FOLDER: with lego400, fern and fox (default: $SNERG_DATA). ROWS=lego-2,fern: only those.
bench-train: setup
	$(PY) bench/train.py $(if $(DATA),--data "$(DATA)") $(if $(ROWS),--rows "$(ROWS)")

# FIELD=FOLDER: a trained field (default: one of the demo's scene). DATA=FOLDER: its dataset. ROWS=bake,preview: only those.
bench-grid: setup
	$(PY) bench/grid.py $(if $(FIELD),--field "$(FIELD)") $(if $(DATA),--data "$(DATA)") $(if $(ROWS),--rows "$(ROWS)")

# BLENDER=/path/to/blender and BROWSER=/path/to/chromium, on the same OpenGL: the viewport's frame time against the web viewer's.
bench-viewport: setup
	$(PY) bench/viewport.py --blender "$(BLENDER)" --browser "$(BROWSER)"

# FIELDS="FIELD ...": of which to compare estimates with measurements and refit the cost model (default: those of bench-train).
bench-estimate: setup
	$(PY) bench/estimate.py $(FIELDS)

# DATASETS="DATASET ...": on which to compare the estimates of the panel's presets with what they take (default: the demo's).
bench-presets: setup
	$(PY) bench/presets.py $(if $(PRESETS),--presets "$(PRESETS)") $(DATASETS)

# ROWS="VIEWSxSAMPLESxPIXELS ...": how the demo's scene is rendered. SECONDS=150: from its cameras to its page, of each row.
bench-page: setup
	$(PY) bench/page.py $(if $(SECONDS),--seconds $(SECONDS)) $(if $(RESOLUTION),--resolution $(RESOLUTION)) $(ROWS)

# Every numerical promise on N random scenes (default: 1000); SEED=1: others. Exit status 1 where one does not hold.
proof: setup
	$(PY) bench/proof.py --count $(or $(N),1000) --seed $(or $(SEED),0)

# Every reader on N damaged files (default: 5000); SEED=1: others.
fuzz: setup
	$(PY) bench/fuzz.py --count $(or $(N),5000) --seed $(or $(SEED),0)

# Naive forms put back one at a time, and the tests that should see them: all of mutation/*.toml; KIND=losses,ndc: some lists; NAME=KIND/NAME: one;
# PART=10 SEED=TEXT: a tenth drawn with that seed, without those that take minutes. JOBS=2: workers.
mutation: setup
	$(PY) mutation/run.py $(if $(KIND),--kind "$(KIND)") $(if $(NAME),--name "$(NAME)") $(if $(PART),--part $(PART)) $(if $(SEED),--seed "$(SEED)") $(if $(JOBS),--jobs $(JOBS))

# The table of tests and mutations in docs/hard-cases.md, written anew; make lint says where it is old.
hard-cases: $(VENV)/.installed
	$(PY) tools/hard_cases.py

# A file of tests stays in one process, because its tests share what it makes. Blender goes first: it crashes where a browser was driven before.
PYTEST = $(PY) -m pytest --numprocesses=auto --maxprocesses=4 --dist=loadfile --no-loadscope-reorder

# TESTS="FILE ...": only those.
TESTS ?= $(if $(BPY),tests/blender)
test: setup
	$(PYTEST) $(TESTS)

test-slow: setup
	$(PYTEST) -m slow || [ $$? -eq 5 ] # 5: there are none

# BLENDER=/path/to/blender: a full one, of 4.5 or newer, whose Python has JAX, Pillow and msgpack. Pictures: build/window.
test-blender: setup
	BLENDER="$(BLENDER)" $(PY) -m pytest -m window -rs tests/window

# mypy wants the root to be called snerg, whatever the clone is called.
lint: $(VENV)/.installed node_modules/.installed
	$(PY) -m ruff check .
	$(PY) -m ruff format --check .
	$(PY) tools/hard_cases.py --check
	mkdir -p build/types && ln -sfn ../.. build/types/snerg
	MYPYPATH=build/types $(PY) -m mypy $(TYPED)
	$(PY) -m pytest -q tests/test_arrows.py tests/test_docstrings.py
	npm run --silent lint

format: $(VENV)/.installed node_modules/.installed
	$(PY) -m ruff check --fix .
	$(PY) -m ruff format .
	npm run --silent format -w viewer

extension: setup
	$(PY) tools/build_extension.py

# Every platform's zips, built, validated and checked against the version and the changelog, in build/release.
release: setup
	$(PY) tools/release.py $(if $(BLENDER),--blender "$(BLENDER)")

# The documentation as a site, in build/site. A broken link is an error.
build/docs-venv/.installed: requirements-docs.txt | python
	test -x build/docs-venv/bin/python || "$(INTERPRETER)" -m venv build/docs-venv
	build/docs-venv/bin/python -m pip install --disable-pip-version-check -q -r requirements-docs.txt
	touch $@

docs: build/docs-venv/.installed
	NO_MKDOCS_2_WARNING=1 build/docs-venv/bin/python -m mkdocs build --strict

# BLENDER=/path/to/blender: a full one, as for test-blender. Draws docs/pictures anew from the result of `make demo`.
pictures: setup
	$(PY) tools/pictures.py --blender "$(BLENDER)"

clean:
	rm -rf build .venv .venv-* node_modules viewer/dist *.egg-info
