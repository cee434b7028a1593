# Everything sets itself up: needs Python 3.11 or newer, git and make.
PYTHON ?= $(shell command -v python3.11 || command -v python3)
VENV   := .venv
PY     := $(VENV)/bin/python

.PHONY: demo test bench soak lint clean

demo: $(VENV)/.user
	$(PY) -m uorb_net.cli demo $(ARGS)

test: $(VENV)/.dev lint
	$(PY) -m pytest $(ARGS)

lint: $(VENV)/.dev
	$(PY) -m ruff check .
	$(PY) -m ruff format --check .
	$(PY) -m mypy

# The long forms of the storms: an hour's worth of kills and wake-ups in some minutes.
soak: $(VENV)/.dev
	UORB_STORM_KILLS=3000 UORB_WAKEUP_ROUNDS=1000000 $(PY) -m pytest tests/broker/test_storm.py tests/broker/test_wakeups.py -v $(ARGS)

bench: $(VENV)/.dev
	$(PY) -m bench $(ARGS)

# The stamps hold the install to what pyproject.toml asks for; editable, so that edits need no reinstall.
$(VENV)/.user: pyproject.toml
	$(PYTHON) -m venv $(VENV)
	$(PY) -m pip install --quiet --disable-pip-version-check -e .
	touch $@

$(VENV)/.dev: $(VENV)/.user
	$(PY) -m pip install --quiet --disable-pip-version-check -e '.[dev]'
	touch $@

clean:
	rm -rf $(VENV) build dist .mypy_cache .ruff_cache .pytest_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
