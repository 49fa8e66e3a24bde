# `make demo` on a fresh machine sets everything up and takes the whole path once.
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
export SPLATAM_DATA ?= $(abspath ../shared/data)
export PIP_DISABLE_PIP_VERSION_CHECK := 1

.PHONY: help setup test lint tf2_msgs demo paper-tables colcon check-aarch64 clean

help:
	@echo 'make setup           make $(VENV) with everything in it (PYTHON=python3.11 chooses the interpreter)'
	echo 'make test            run the whole test suite'
	echo 'make lint            style and likely mistakes, by ruff'
	echo 'make tf2_msgs        build the messages of /tf into $(VENV), for a ROS from pip, which lacks them'
	echo 'make demo [BAG=path] play a recording into the node and score what comes out, in out/demo'
	echo 'make paper-tables    ablations, metrics and held-out views on the recordings in SPLATAM_DATA: hours, and goes on where it stopped'
	echo 'make colcon          build and test as a ROS package, in a scratch workspace'
	echo 'make check-aarch64   compile the kernels for the processors of robots'
	echo 'make clean           remove what was built; $(VENV) and out stay'

setup: $(VENV)/.native $(VENV)/.installed

$(VENV)/.created:
	@if [[ -z '$(PYTHON)' ]]; then echo 'splatam_ros needs Python 3.10, 3.11 or 3.12: apt install python3 python3-venv, or PYTHON=path' >&2; exit 1; fi
	$(PYTHON) -c '$(CHECK_PYTHON)' || { echo "PYTHON=$(PYTHON) is not Python 3.10, 3.11 or 3.12" >&2; exit 1; }
	$(PYTHON) -m venv $(VENV) || { echo '$(PYTHON) cannot make a virtual environment: apt install python3-venv' >&2; exit 1; }
	touch $@

# The kernels come first: what a machine lacks to compile them should be said before the long download.
$(VENV)/.native: $(CSRC) setup.py package.xml constraints.txt | $(VENV)/.created
	@echo 'building the kernels'
	$(BIN)/python -m pip install --quiet -c constraints.txt setuptools pybind11
	$(BIN)/python setup.py --quiet build_ext --inplace --force
	touch $@

$(VENV)/.installed: setup.py package.xml pyproject.toml constraints.txt | $(VENV)/.native
	@echo 'installing what splatam_ros needs into $(VENV): some minutes the first time'
	PYTHONWARNINGS=ignore $(BIN)/python -m pip install --quiet -c constraints.txt --no-build-isolation -e '.[ros,test]'
	touch $@

# TF for a ROS that comes from pip, which has no tf2_msgs; where ROS is installed it is there already.
tf2_msgs: $(VENV)/.tf2_msgs
$(VENV)/.tf2_msgs: tools/tf2_msgs.py | $(VENV)/.installed
	@echo 'generating tf2_msgs into $(VENV)'
	$(BIN)/python -c 'import tf2_msgs.msg' 2>/dev/null || $(BIN)/python tools/tf2_msgs.py $(VENV)
	touch $@

test: setup tf2_msgs
	@$(BIN)/python -m pytest -q

lint: $(VENV)/.created
	@$(BIN)/python -m pip install --quiet -c constraints.txt ruff
	$(BIN)/python -m ruff check .

demo: setup
	@$(BIN)/python -m splatam_ros.demo $(if $(BAG),'$(BAG)')

paper-tables: setup
	@$(BIN)/python benchmarks/paper_tables.py --data "$$SPLATAM_DATA"

# A ROS workspace as colcon sees it, outside the checkout; its virtual environment does not hold splatam_ros.
colcon: $(VENV)/.created
	@scratch=$$(mktemp -d)
	trap 'rm -rf "$$scratch"' EXIT
	venv=$$scratch/venv package=$$scratch/workspace/src/splatam_ros
	mkdir -p "$$package"
	git ls-files -z --cached --others --exclude-standard | xargs -0 cp --parents -t "$$package"
	$(BIN)/python -m venv "$$venv"
	export PATH=$$venv/bin:$$PATH AMENT_PREFIX_PATH=$$venv CMAKE_PREFIX_PATH=$$venv
	echo 'installing colcon and what splatam_ros needs: some minutes'
	pip install --quiet -c constraints.txt "$$package[ros,test]" pybind11
	pip uninstall --quiet --yes splatam_ros
	pip install --quiet colcon-common-extensions
	rm -rf "$$package"/build "$$package"/*.egg-info
	cd "$$scratch/workspace"
	colcon build
	colcon test
	colcon test-result --all --verbose

# Everything but running it: the shipping flags, a cross compiler, and this machine's Python headers.
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

clean:
	@rm -rf build dist install log *.egg-info .pytest_cache .hypothesis .ruff_cache
	rm -f splatam_core/_native*.so $(VENV)/.native
	find . -name __pycache__ -not -path './$(VENV)/*' -prune -exec rm -rf {} +
