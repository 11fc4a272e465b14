# Two commands set everything up on a fresh machine: `make demo` and `make test`.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
# Our products are small: one BLAS thread is fastest.
export OPENBLAS_NUM_THREADS := 1
# Without bytecode files every test process would compile all modules again.
unexport PYTHONDONTWRITEBYTECODE

# `make CONSTRAINTS=constraints.txt …` installs the versions that the checks run with; without it, the newest allowed.
CONSTRAINTS ?=
PIP_INSTALL := $(BIN)/python -m pip install --disable-pip-version-check $(if $(CONSTRAINTS),--constraint $(CONSTRAINTS))

.PHONY: lock coverage notebook install install-dev system-packages demo demo-python docs docs-site test test-long test-computing test-waiting test-fast lint format clean

# Before anything is installed.
demo-python:
	@[ -e $(VENV)/.installed ] || $(PYTHON) -c 'import sys; v = sys.version.split()[0]; sys.version_info < (3, 13) or sys.exit(f"The demo drives an emulated robot, and its package ur-rtde has no wheel for Python {v}: make demo PYTHON=python3.12. To build ur-rtde, see docs/hardware-setup.md.")'

# The demo needs the least; `install` adds what the exports need, `install-dev` the tools of tests and checks.
install: $(VENV)/.installed-exports
install-dev: $(VENV)/.installed-dev

$(VENV)/.installed: pyproject.toml
	@$(PYTHON) -c 'import sys; v = sys.version.split()[0]; sys.version_info >= (3, 11) or sys.exit(f"Python {v} is too old: shearloop needs 3.11 or later, e.g. `make demo PYTHON=python3.12`.")'
	$(PYTHON) -m venv $(VENV)
	$(PIP_INSTALL) --editable '.[plot,view]'
	touch $@

$(VENV)/.installed-exports: pyproject.toml $(VENV)/.installed
	$(PIP_INSTALL) --editable '.[export,rerun]'
	touch $@

$(VENV)/.installed-dev: pyproject.toml $(VENV)/.installed
	$(PIP_INSTALL) --editable '.[dev]'
	touch $@

# Debian packages for the tests of the service and of the live page, which are skipped without them.
system-packages:
	missing=; \
	command -v systemd-analyze >/dev/null || missing="$$missing systemd"; \
	command -v chromium >/dev/null || missing="$$missing chromium fonts-dejavu-core"; \
	command -v g++ >/dev/null || missing="$$missing g++"; \
	[ -e /usr/include/zmq.h ] || missing="$$missing libzmq3-dev"; \
	[ -e /usr/include/nlohmann/json.hpp ] || missing="$$missing nlohmann-json3-dev"; \
	[ -z "$$missing" ] || { apt-get update -qq -o Acquire::Retries=2 -o Acquire::http::Timeout=30 && apt-get install -y -qq --no-install-recommends $$missing; }

# A person's stop (4), Ctrl-C (130) and an end on request (143) are no errors of make; a fault's stop is: the demo has said what happened.
# The whole emulated rig; with RECORDING=FILE one fingertip that plays a recorded stream (.mat).
demo: demo-python $(VENV)/.installed
	$(BIN)/shearloop demo --folder . $(if $(RECORDING),--play '$(RECORDING)') || case $$? in 4|130|143) ;; *) exit 1 ;; esac

# Test files run in parallel, the longest first (tests/conftest.py). Three parts:
#   Tests that drive a robot in real time run by themselves, because a robot stops when its computer is busy. They mostly
#   wait, so that more of them fit on two cores.
#   Then the rest runs, which waits a little less.
#   Tests that only compute run beside both. The scheduler gives them what time the others leave of the cores, and takes
#   it away at once (SCHED_IDLE). On a busy computer they get little time, so that their timeout is long.
# Status 5: no test was selected.
# `make test` takes about five minutes, and `make test-long` nearly as long: endurance, a newcomer's first hour, each seeded
# fault of commissioning, and figures (LONG in tests/conftest.py, and `pytest.mark.long`). `.ci/run` calls both.
PYTEST := $(BIN)/pytest --dist loadfile --no-loadscope-reorder
LENGTH := not long
# The long ones in real time have boards of many times the rated pace, which take a core each.
IN_REAL_TIME := 5
# Not every container allows it.
IN_IDLE_TIME := $(shell chrt --idle 0 true 2>/dev/null && echo chrt --idle 0 || echo nice -n 19)
test: install-dev
	# Once, not in each of the processes that begin together.
	@$(BIN)/python -m compileall -q benchmarks src/shearloop $(wildcard src/shearloop/*/)
	+$(MAKE) --no-print-directory --jobs=2 --keep-going test-computing test-waiting

test-long: install-dev
	+$(MAKE) --no-print-directory test LENGTH=long IN_REAL_TIME=3

test-computing: install-dev
	mkdir -p build
	$(IN_IDLE_TIME) $(PYTEST) -n 2 -m 'computes and $(LENGTH)' --timeout=600 $(PYTEST_ARGS) >build/test-computing.log 2>&1 || \
		[ $$? -eq 5 ] || { cat build/test-computing.log; exit 1; }
	tail -n 1 build/test-computing.log

test-waiting: install-dev
	$(PYTEST) -n $(IN_REAL_TIME) -m 'real_time and $(LENGTH)' $(PYTEST_ARGS) || [ $$? -eq 5 ]
	$(PYTEST) -n 3 -m 'not real_time and not computes and $(LENGTH)' $(PYTEST_ARGS) || [ $$? -eq 5 ]

# What depends most on the versions of Python and of the libraries; nothing in real time.
FAST := tests/test_package.py $(addprefix tests/bank/test_,bank_file.py forward.py matching.py models.py) \
	$(addprefix tests/estimation/test_,archive.py regressors.py values.py) \
	$(wildcard tests/drivers/test_*.py) tests/drivers/shear_skin \
	$(addprefix tests/drivers/ur/test_,limits.py messages.py settings.py) tests/daemon/messaging \
	$(addprefix tests/tools/recordings/test_,replay.py tools.py) tests/daemon/recorder/test_schemas.py tests/cli/test_docgen.py \
	tests/cli/test_start.py \
	$(addprefix tests/cli/test_cli.py::test_,bash_completes_commands_and_options every_shell_has_its_script) \
	$(addprefix tests/daemon/test_,config_file.py process.py settings.py)
test-fast: install-dev
	$(PYTEST) -n 3 -m 'not real_time' $(PYTEST_ARGS) $(FAST)

# Lines and branches that the tests run in their own process; what runs in processes of its own is not seen.
coverage: install-dev
	$(PYTEST) -n 3 -m 'not real_time' --cov --cov-report=term:skip-covered --cov-report=html:build/coverage $(PYTEST_ARGS)

lock: install-dev
	{ echo '# The versions that the checks run with. `make lock` writes this file from the environment.'; \
	  $(BIN)/python -m pip freeze --exclude-editable; } >constraints.txt

lint: install-dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

format: install-dev
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

# The notebook with its outputs. It runs in a folder of its own, because it records.
notebook: install-dev
	rm -rf build/notebook && mkdir -p build/notebook
	cp docs/first-recording.ipynb build/notebook/
	cd build/notebook && ../../$(BIN)/jupyter-execute --inplace first-recording.ipynb
	cp build/notebook/first-recording.ipynb docs/

# The generated pages.
docs: $(VENV)/.installed
	$(BIN)/python -m shearloop.cli.docgen

# The pages as a site in build/site; every warning is an error. The variable silences an advertisement.
docs-site: install-dev
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --quiet --strict

clean:
	rm -rf $(VENV) build dist *.egg-info .mypy_cache .ruff_cache .pytest_cache .import_linter_cache .hypothesis
