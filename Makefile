# On a fresh machine: `make demo` runs the main job on the scene that ships with mvseg, `make test` passes the tests.
VENV := .venv
PYTHON := $(VENV)/bin/python

.PHONY: demo test lint clean

demo: $(VENV)/installed
	$(PYTHON) infer.py

test: $(VENV)/installed
	$(PYTHON) -m pytest -n 2

lint: $(VENV)/installed
	$(PYTHON) -m ruff check .
	$(PYTHON) -m mypy

$(VENV)/installed: pyproject.toml
	python3 -m venv $(VENV)
	$(PYTHON) -m pip install --quiet --upgrade pip
	$(PYTHON) -m pip install --quiet --editable '.[test,lint]'
	touch $@

clean:
	rm -rf $(VENV) results
