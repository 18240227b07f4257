# make demo   the main job on simulated grasps, with a report     make test   lint, formatting, types and tests
# Both make their own .venv. PYTHON=/path/to/python3 chooses the interpreter.

# torch 2.13.0 on Python 3.11 is the pinned pair (constraints.txt). A python3.11 on the PATH may be a shim that fails,
# so each candidate has to prove that it runs and can make an environment.
PYTHON ?= $(shell for p in python3.11 /usr/bin/python3.11 python3.12 python3.13 python3.10 python3; do \
	$$p -c 'import ensurepip, venv, sys; sys.exit(sys.version_info < (3, 10))' >/dev/null 2>&1 && echo $$p && break; done)
BIN := .venv/bin

.PHONY: demo test format clean

demo: .venv/installed
	$(BIN)/adaptfault demo

test: .venv/installed-dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/pytest

format: .venv/installed-dev
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

.venv/installed: pyproject.toml constraints.txt
	@echo 'installing into .venv (torch is large: a minute or more)'
	@test -n "$(PYTHON)" || { echo "make: no working python3 (3.10 to 3.13) with venv found; name one: make PYTHON=/path/to/python3 ..."; exit 1; }
	test -x $(BIN)/python || $(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --no-compile --disable-pip-version-check -c constraints.txt -e .
	@touch $@

.venv/installed-dev: .venv/installed
	$(BIN)/python -m pip install --quiet --no-compile --disable-pip-version-check -c constraints.txt -e '.[dev]'
	@touch $@

clean:
	rm -rf .venv adaptfault-demo
