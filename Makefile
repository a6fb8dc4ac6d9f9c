# Two commands for a newcomer: `make demo` and `make test`. Both make their own virtual environment first.
SUPPORTED := import sys; sys.exit(not sys.version_info >= (3, 11))
PYTHON ?= $(shell for name in python3.12 python3.11 python3.13 python3.14 python3; do \
  $$name -c '$(SUPPORTED)' 2>/dev/null && echo $$name && break; done)
VENV := .venv
BIN := $(VENV)/bin

.PHONY: demo test long numbers lint site clean

$(VENV)/installed: pyproject.toml constraints.txt
	@test -n "$(PYTHON)" && $(PYTHON) -c '$(SUPPORTED)' \
	  || { echo "potlp-jax needs Python 3.11 or later; name one: make PYTHON=/path/to/python3.12 demo"; exit 1; }
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable '.[dev,docs]'
	@touch $@

demo: $(VENV)/installed  ## Fire-fighting task 2 in five worlds: a table, both policies in world 2 side by side, an animation
	$(BIN)/potlp compare firefighting --task 2 --policies potlp --trials 5 --picture 2 --out out/demo
	$(BIN)/potlp run firefighting --task 2 --world 2 --out out/demo/potlp
	@echo "Over 750 worlds PO-TLP costs less than the baseline in 100.0 % and the same in 0.0 %: docs/results/table1.md."
	@echo "Baseline and PO-TLP side by side: out/demo/world-2.png; PO-TLP decision by decision: out/demo/potlp/trial.gif"

test: $(VENV)/installed  ## The suite, but for the longest tests: under ten minutes on two cores
	$(BIN)/python -m pytest -n 2 --dist loadfile -m 'not long'

long: $(VENV)/installed  ## The longest tests, but for those that `make numbers` runs
	$(BIN)/python -m pytest -n 2 --dist loadfile -m 'long and not numbers'

numbers: $(VENV)/installed  ## Tests that compare numbers and take long to optimise, compiled as users' programs are
	$(BIN)/python -m pytest -n 2 --dist loadfile -m numbers --optimised

lint: $(VENV)/installed  ## Style, format and types
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright

site: $(VENV)/installed  ## The documentation, in out/site; warnings are errors
	$(BIN)/mkdocs build --strict

clean:
	rm -rf $(VENV) out
