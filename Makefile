# Everything is installed into .venv, which the first call creates if it does not exist.
#
#   make demo         the main job on a simulated vehicle
#   make test         the tests                      make lint       style and types
#   make test-slow    tests in real time, of many processes, and of every program and command in the documentation
#   make test-all     test, test-slow, lint-platforms, and soak, kills and fuzz for some minutes each
#   make coverage     the tests with their coverage  make docs       the documentation, into docs/_build/html
#   make bench        CPU, memory, time to start     make dist       wheel and sdist, into dist
#   make peers        downloads, compared with other clients
#   make fuzz         each target of fuzz/ for SECONDS
#   make soak         random sessions                make kills      programs killed while they write
#   make sync         generates the types of the blocking client
#   make reference    the generated parts of docs/command.md and docs/json.md
#   make clean        removes .venv and all other files that these commands create
#   make pictures     the comparison with other clients as pictures, into docs/images
#   make screenshots  screenshots of the web page, into docs/images
#   make live LINK=udpin:127.0.0.1:14550   checks on a real vehicle, which must be disarmed

PYTHON ?= $(shell for python in python3 python3.14 python3.13 python3.12 python3.11; do \
	"$$python" -c $(IS_NEW_ENOUGH) 2>/dev/null && echo "$$python" && break; done)
IS_NEW_ENOUGH = 'import sys; sys.exit(sys.version_info < (3, 11))'

VENV ?= .venv
BIN = $(VENV)/bin
PIP = $(BIN)/python -m pip install --quiet --disable-pip-version-check
TESTS ?=
SESSIONS ?= 10000
KILLS ?= 1000
TARGETS ?= component files framer metadata pack signing tlog
SECONDS ?= 1800
LINK ?=
KIND ?=
SYSTEM ?=
ONLY ?=
LINK2 ?=
READ_ONLY ?=
REBOOT ?=

MEASURED = 'model/*' 'protocol/*' 'sim/*' 'cache/*' 'files/*' errors.py

# more workers than cores: many tests wait for a process, a socket or a timeout
WORKERS ?= $(shell $(BIN)/python -c 'import os; print((os.cpu_count() or 1) + 2)')

# the tests start several hundred processes; without bytecode, each of them would compile paramclient again
unexport PYTHONDONTWRITEBYTECODE

.PHONY: demo test test-slow test-all coverage soak kills live fuzz lint lint-platforms docs screenshots pictures sync reference bench peers dist clean
.NOTPARALLEL:

demo: $(VENV)/with-cli
	@$(BIN)/python examples/demo.py

test: $(VENV)/with-test
	$(BIN)/python -m pytest -m 'not slow' --numprocesses $(WORKERS) $(TESTS)

test-slow: $(VENV)/with-test
	$(BIN)/python -m pytest -m slow --numprocesses $(WORKERS) $(TESTS)

test-all:
	$(MAKE) test
	$(MAKE) test-slow
	$(MAKE) lint-platforms
	$(MAKE) soak SESSIONS=1000
	$(MAKE) kills KILLS=100
	$(MAKE) fuzz SECONDS=30

coverage: $(VENV)/with-test
	$(BIN)/python -m pytest -m 'not slow' --numprocesses $(WORKERS) --cov --cov-report= $(TESTS)
	@failed=; for room in $(MEASURED); do \
		echo "== paramclient/$$room"; \
		$(BIN)/coverage report --include="paramclient/$$room" --fail-under=95 || failed=1; \
	done; test -z "$$failed"

soak: $(VENV)/with-test
	SESSIONS=$(SESSIONS) $(BIN)/python -m pytest -m slow --numprocesses auto tests/conversations/test_sessions.py

kills: $(VENV)/with-test
	$(BIN)/python bench/kills.py --kills $(KILLS)

# prints its usage without LINK; see docs/testing.md
live: $(VENV)/with-test
	@$(BIN)/python -m tests.live $(LINK) $(if $(KIND),--kind $(KIND)) $(if $(SYSTEM),--system $(SYSTEM)) \
		$(if $(ONLY),--only '$(ONLY)') $(if $(LINK2),--second-link $(LINK2)) \
		$(if $(filter yes,$(READ_ONLY)),--read-only) $(if $(filter yes,$(REBOOT)),--reboot)

# Inputs that reach new code are added to fuzz/corpus, inputs that fail to fuzz/findings. `python -m fuzz.keep TARGET`
# removes the inputs of a corpus that are not needed.
fuzz: $(VENV)/with-test $(VENV)/with-fuzz
	@for target in $(TARGETS); do \
		echo "== fuzz/$$target.py, $(SECONDS) s"; \
		$(BIN)/python -m fuzz $$target --seconds $(SECONDS) || exit 1; \
	done

lint: $(VENV)/with-test $(VENV)/with-lint
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/mypy

# types of the code for other platforms
lint-platforms: $(VENV)/with-test $(VENV)/with-lint
	$(BIN)/mypy --platform darwin paramclient
	$(BIN)/mypy --platform win32 paramclient

docs: $(VENV)/with-docs
	$(BIN)/sphinx-build --fail-on-warning --keep-going --fresh-env -d docs/_build/doctrees docs docs/_build/html

screenshots: $(VENV)/with-test
	$(BIN)/python -m tests.screenshots

# the types of the blocking client; needed after each change of the asynchronous one, and a test compares
sync: $(VENV)/with-test
	$(BIN)/python -m tests.sync_stub

# needed after each change of a subcommand or of the JSON; a test compares
reference: $(VENV)/with-cli
	$(BIN)/python docs/reference.py

# needed after each change of the tables in docs/performance.md; a test compares the result
pictures: $(VENV)/made
	$(BIN)/python bench/pictures.py

bench: $(VENV)/with-cli
	$(BIN)/python bench/parse.py
	$(BIN)/python bench/cost.py

peers: $(VENV)/with-peers
	$(BIN)/python bench/peers.py

dist: $(VENV)/with-test
	rm -rf dist
	$(BIN)/hatchling build

clean:
	rm -rf $(VENV) dist docs/_build htmlcov .coverage .coverage.* .hypothesis .mypy_cache .pytest_cache .ruff_cache
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

# The virtual environment and its dependency groups, installed again when pyproject.toml changes.

$(VENV)/made:
	@if $(BIN)/python -c $(IS_NEW_ENOUGH) 2>/dev/null && $(BIN)/python -m pip --version >/dev/null 2>&1; then \
		echo "Using the existing $(VENV)"; \
	elif test -n "$(PYTHON)" && "$(PYTHON)" -c $(IS_NEW_ENOUGH); then \
		echo "Making $(VENV) with $(PYTHON)" && "$(PYTHON)" -m venv --clear $(VENV); \
	else \
		echo "paramclient needs Python 3.11 or newer; name one: make PYTHON=/path/to/python3.12"; exit 1; \
	fi
	@touch $@

$(VENV)/with-cli: pyproject.toml $(VENV)/made
	@echo "Installing paramclient into $(VENV)"
	@$(PIP) --editable '.[cli,serial,service]'
	@touch $@

# dependency groups need pip 25.1; the pip of a new environment may be older
$(VENV)/with-test $(VENV)/with-lint $(VENV)/with-docs $(VENV)/with-peers $(VENV)/with-fuzz: $(VENV)/with-%: pyproject.toml $(VENV)/with-cli
	@echo "Installing what $* needs into $(VENV)"
	@$(PIP) 'pip>=25.1'
	@$(PIP) --group $*
	@touch $@
