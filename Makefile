# make demo       the main job on simulated grasps, with a report     make test         lint, formatting, types and tests
# make test-all   the same with the tests that take long              make test-cpus    the tests as on other CPUs
# make examples   every script of examples/, and every block of code in the docs, small; the quick ones are in make test
# make benchmark  the diagnosis on every array, against the committed table (BENCHMARK=--quick: minutes)
# make docs       the site, in build/site: pages and API reference    make wheel-check  the wheel, installed somewhere else
# They make their own .venv. PYTHON=/path/to/python3 chooses the interpreter.

# torch 2.13.0 on Python 3.11 is the pinned pair (constraints.txt). A python3.11 on the PATH may be a shim that fails,
# so each candidate has to prove that it runs and can make an environment.
PYTHON ?= $(shell for p in python3.11 /usr/bin/python3.11 python3.12 python3.13 python3.10 python3; do \
	$$p -c 'import ensurepip, venv, sys; sys.exit(sys.version_info < (3, 10))' >/dev/null 2>&1 && echo $$p && break; done)
BIN := .venv/bin
INSTALL = $(BIN)/python -m pip install --quiet --no-compile --disable-pip-version-check
CONSTRAINTS := -c constraints.txt
PACKAGES := $(wildcard packages/*)

.PHONY: demo test test-all test-cpus check quick-tests all-tests examples benchmark docs wheel-check lerobot-check remote-check findings test-pythons install-dev format clean

demo: .venv/installed
	$(BIN)/adaptfault demo

PYTEST := $(BIN)/pytest -n auto --dist worksteal

# Many tests start Python: where bytecode is not kept, each start compiles torch and scikit-learn, 5 to 10 seconds.
export PYTHONDONTWRITEBYTECODE :=

# Side by side: mypy takes one core, and the tests wait for each other now and then.
test: .venv/installed-dev
	@$(MAKE) --no-print-directory -j 2 check quick-tests

test-all: .venv/installed-dev
	@$(MAKE) --no-print-directory -j 2 check all-tests

check:
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

quick-tests:
	OMP_NUM_THREADS=1 $(PYTEST) -m 'not slow'

all-tests:
	OMP_NUM_THREADS=1 $(PYTEST)

# Sums come out otherwise with other instructions, and with more threads. A CPU without AVX-512 takes what it has.
test-cpus: .venv/installed-dev
	for how in 'default SSE4_2 Prescott 1' 'avx2 AVX2 Haswell 2' 'avx512 AVX512 SkylakeX 1' 'avx512 AVX512 SkylakeX 2'; do \
		set -- $$how; echo "$$how threads" && ATEN_CPU_CAPABILITY=$$1 MKL_ENABLE_INSTRUCTIONS=$$2 OPENBLAS_CORETYPE=$$3 \
		OMP_NUM_THREADS=$$4 $(PYTEST) -m 'not slow' || exit 1; done

examples: .venv/installed-dev
	OMP_NUM_THREADS=1 $(PYTEST) -vv -rs tests/project/test_examples.py tests/project/test_docs.py

# Real arrays are read from ../shared/data where it exists.
benchmark: .venv/installed-dev
	$(BIN)/python benchmarks/diagnosis.py --against benchmarks/table.jsonl $(BENCHMARK)

# Warnings are errors: links and names that lead nowhere, public names that are on no page.
docs: .venv/installed-docs
	rm -rf build/site docs/api/modules
	$(BIN)/python -m sphinx --quiet --fail-on-warning --keep-going --jobs auto -d build/doctrees docs build/site
	$(BIN)/python docs/check_links.py build/site
	@echo build/site/index.html

wheel-check: .venv/installed-dev
	rm -rf dist
	$(BIN)/python -m build --outdir dist .
	for package in $(PACKAGES); do $(BIN)/python -m build --wheel --outdir dist $$package || exit 1; done
	$(BIN)/python tests/check_wheel.py dist

# LeRobot brings gigabytes, and another torch: an environment of its own.
lerobot-check:
	test -e build/lerobot/bin/python || $(PYTHON) -m venv build/lerobot
	build/lerobot/bin/python -m pip install --quiet --disable-pip-version-check '.[datasets]' \
		./packages/adaptfault-viewers ./packages/adaptfault-station './packages/lerobot_policy_adaptfault[lerobot]'
	build/lerobot/bin/python tests/check_lerobot.py
	build/lerobot/bin/python tests/check_touch_step.py

# A store in the manner of S3 and a Hub that run here, and ones that do not answer: an environment of its own.
remote-check:
	test -e build/remote/bin/python || $(PYTHON) -m venv build/remote
	build/remote/bin/python -m pip install --quiet --disable-pip-version-check $(CONSTRAINTS) '.[datasets,remote]' 'moto[server,s3]>=5'
	build/remote/bin/python tests/check_remote.py

# Each installs what it names from PyPI; one after the other, and all of them although one fails.
findings:
	@failed=0; for one in findings/*.sh; do echo "$$one"; sh "$$one" || failed=1; done; exit $$failed

# With the newest of all packages, on each other Python that is found and runs. On Linux torch brings 6 GB for each.
test-pythons:
	@for python in python3.10 python3.12 python3.13 $$HOME/.pyenv/versions/3.1[023].*/bin/python3; do \
		version=$$($$python -c 'import ensurepip, sys; print("%d.%d" % sys.version_info[:2])' 2>/dev/null) || continue; \
		test -e .venv-$$version/tested && continue; echo "Python $$version ($$python)"; \
		$$python -m venv .venv-$$version && \
		$(MAKE) --no-print-directory BIN=.venv-$$version/bin CONSTRAINTS= install-dev && \
		$(MAKE) --no-print-directory BIN=.venv-$$version/bin quick-tests && \
		touch .venv-$$version/tested || exit 1; \
	done; rm -f .venv-*/tested

format: .venv/installed-dev
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

.venv/installed: pyproject.toml constraints.txt $(PACKAGES:=/pyproject.toml)
	@echo 'installing into .venv (torch is large: a minute or more)'
	@test -n "$(PYTHON)" || { echo "make: no working python3 (3.10 to 3.13) with venv found; name one: make PYTHON=/path/to/python3 ..."; exit 1; }
	$(BIN)/python -m pip --version >/dev/null 2>&1 || $(PYTHON) -m venv --clear .venv  # also where it was cut off
	$(INSTALL) $(CONSTRAINTS) -e . $(PACKAGES:%=-e ./%)
	@touch $@

.venv/installed-dev: .venv/installed
	@$(MAKE) --no-print-directory install-dev
	@touch $@

install-dev:
	$(INSTALL) $(CONSTRAINTS) -e '.[dev]' -e './packages/adaptfault-bench[mujoco]' -e ./packages/adaptfault-firmware \
		-e './packages/adaptfault-fleet[dask]' -e ./packages/adaptfault-paper -e ./packages/adaptfault-prognosis \
		-e './packages/adaptfault-station[ros2]' -e './packages/adaptfault-viewers[ros,view]' -e ./packages/lerobot_policy_adaptfault

.venv/installed-docs: .venv/installed
	$(INSTALL) $(CONSTRAINTS) -e '.[docs]'
	@touch $@

clean:
	rm -rf .venv .venv-* adaptfault-demo build dist docs/api/modules
