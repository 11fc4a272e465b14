# Two commands set everything up on a fresh machine: `make demo` and `make test`.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
# Many small solves: one BLAS thread each, on every machine.
export OPENBLAS_NUM_THREADS := 1
# Some containers forbid Python to keep what it compiled; every process of the tests would then compile all of them anew.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: install install-dev system-packages demo docs test lint format clean

# What running and drawing take; the tools of the tests and the static checks come with `install-dev`.
install: $(VENV)/.installed
install-dev: $(VENV)/.installed-dev

$(VENV)/.installed: pyproject.toml
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[plot,view]'
	touch $@

$(VENV)/.installed-dev: pyproject.toml $(VENV)/.installed
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[dev]'
	touch $@

# From Debian: for the tests of the service and of the live view's page alone, which skip without them.
system-packages:
	missing=; \
	command -v systemd-analyze >/dev/null || missing="$$missing systemd"; \
	command -v chromium >/dev/null || missing="$$missing chromium fonts-dejavu-core"; \
	[ -z "$$missing" ] || { apt-get update -qq -o Acquire::Retries=2 -o Acquire::http::Timeout=30 && apt-get install -y -qq --no-install-recommends $$missing; }

# The whole emulated rig; with RECORDING=FILE one fingertip, whose board plays a recorded stream (.mat).
DEMO := $(if $(RECORDING),config/fingertip_demo.yaml --recording '$(RECORDING)',config/demo.yaml)
demo: install run/demo.bank $(if $(RECORDING),,run/rig.cal)
	$(BIN)/shearloop run $(DEMO) --show

# Recordings of the emulated rig, and the calibrations of its fingertips that are made from them.
run/rig.cal: run/demo.bank daemon/cli/demo_calibration.py | install
	$(BIN)/python -m shearloop.daemon.cli.demo_calibration --bank $< --out run

run/demo.bank: config/banks/demo.yaml config/fingertips/paper.yaml | install
	mkdir -p run
	$(BIN)/shearloop bank build --config $< --out $@

# Files are shared out over the processors, the longest first (tests/conftest.py); those that wait for devices leave
# theirs to the others. What drives a robot runs by itself afterwards, the longest test beside all others: a robot stops
# when its computer is busy. Others may keep it busy all the same, so such a test has a second and a third try, which
# the summary names. (Status 5: nothing of this kind was asked for.)
PYTEST := $(BIN)/pytest
test: install-dev
	$(PYTEST) -n 3 --dist loadfile --no-loadscope-reorder -m 'not real_time' $(PYTEST_ARGS) || [ $$? -eq 5 ]
	$(PYTEST) -n 2 --dist loadfile --no-loadscope-reorder -m real_time --reruns 2 --reruns-delay 2 -rR $(PYTEST_ARGS) || [ $$? -eq 5 ]

lint: install-dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

format: install-dev
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

# The pages that are written from the code.
docs: install
	$(BIN)/python -m shearloop.daemon.docgen

clean:
	rm -rf $(VENV) build dist *.egg-info .mypy_cache .ruff_cache .pytest_cache .import_linter_cache .hypothesis
