# On a fresh machine: `make demo` runs the main job on the scene that ships with mvseg, `make test` passes the tests.
VENV := .venv
PYTHON := $(VENV)/bin/python

.PHONY: demo test slow processors fuzz bench lint docs clean

demo: $(VENV)/installed
	$(PYTHON) infer.py

# two processes, one thread each: libraries that start more get in each other's way; each begins with one half of the
# tests, so that what the tests of a file share is made once, as a rule
test slow: export OMP_NUM_THREADS := 1
# they start many processes: what is compiled once need not be compiled by each
test slow: export PYTHONDONTWRITEBYTECODE :=
test slow: PYTEST := $(PYTHON) -m pytest -n 2 --dist worksteal

test: $(VENV)/complete
	$(PYTEST)

# whole commands, pages in a browser, killed workers, notebooks
slow: $(VENV)/complete
	$(PYTEST) -m slow

# the numeric tests in the arithmetic of other processors; ARITHMETICS="sse avx2" tries two of them
processors: $(VENV)/complete
	$(PYTHON) .ci/processors.py $(ARITHMETICS)

# about ten minutes: broken files for every reader, and runs that are killed at random moments
fuzz: $(VENV)/complete
	MVSEG_FUZZ_EXAMPLES=2000 $(PYTHON) -m pytest tests/fuzz
	MVSEG_KILLS=20 MVSEG_KILL_SEED=$$(date +%s) $(PYTHON) -m pytest -m "" tests/test_kill.py

# minutes to hours; PREVIOUS=DIR takes turns with another checkout; SCENES=DIR... are measured in place of simulated ones
bench: $(VENV)/complete
	$(PYTHON) -m benchmarks.speed $(SCENES) $(if $(PREVIOUS),--previous $(PREVIOUS)) $(if $(SKINS),--skins $(SKINS)) \
	    --cache results/speed --threads 1 2 8 --into docs/notes/performance.md

lint: $(VENV)/complete
	$(PYTHON) -m ruff check .
	$(PYTHON) -m mypy

# the site, in build/site; a warning is an error (with --quiet, it would not be)
docs: $(VENV)/complete
	NO_MKDOCS_2_WARNING=1 $(PYTHON) -m mkdocs build --strict --config-file .ci/mkdocs.yml

# what a user needs
$(VENV)/installed: pyproject.toml
	python3 -m venv $(VENV)
	$(PYTHON) -m pip install --quiet --upgrade pip
	$(PYTHON) -m pip install --quiet --editable .
	touch $@

# and what tests, lint and site need besides
$(VENV)/complete: $(VENV)/installed
	$(PYTHON) -m pip install --quiet --editable '.[test,lint,docs]'
	touch $@

clean:
	rm -rf $(VENV) results
