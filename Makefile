# One target per task; `make` without a target lists them. Everything is installed into $(VENV).
PYTHON ?= python3
VENV ?= .venv
BENCH ?= .venv-bench
NEWEST ?= .venv-newest
BIN := $(VENV)/bin
# Without the cache of compiled modules, every process that is started compiles what it imports.
unexport PYTHONDONTWRITEBYTECODE
# Setuptools warns of every editable installation.
PIP := PYTHONWARNINGS=ignore:::setuptools.command.editable_wheel $(BIN)/python -m pip install -qq --disable-pip-version-check -c constraints.txt
# CI also runs the tests that take minutes.
QUICK := $(if $(filter true,$(CI)),,-m "not slow and not long")
EXTRAS := sims,offline,online,contrib,report,tables,video,export,foxglove,bags,dds,remote,ray,fast
# What works with new versions of the dependencies: reading, recording, sims, learning and the API.
NEWEST_TESTS := tests/recorder tests/sims tests/offline tests/online tests/api
# A change of these files reinstalls the environments.
SETTINGS := pyproject.toml constraints.txt setup.py recorder/columns/_native.c

.PHONY: help demo test core newest faults fuzz sanitize check bench bench-learning suite sim-grid docs docs-test vendor wheel clean

help:
	@echo "make demo             record a car, train on its log offline, evaluate, and write the replay"
	@echo "make test             run the tests; with CI=true, also those that take minutes"
	@echo "make core             run the tests of the main paths in two minutes; needs pip alone"
	@echo "make newest           run most tests with the newest version of every dependency (for a schedule)"
	@echo "make faults           run the fault tests at full size: kills, damaged files, changed inputs, failed writes"
	@echo "make fuzz             fuzz the reader for ten minutes"
	@echo "make sanitize         test the C code with AddressSanitizer and UndefinedBehaviorSanitizer (needs gcc)"
	@echo "make check            check format, lint, words, types, import contracts and the size of the code"
	@echo "make bench            measure speed relative to other libraries"
	@echo "make suite            train and score all learners on the logs of the benchmark's first tier"
	@echo "make bench-learning   measure training and off-policy estimates relative to d3rlpy, SB3 and SCOPE-RL"
	@echo "make sim-grid         train offline on six logs of each sim, four seeds (hours; resumes if interrupted)"
	@echo "make docs             generate the references and images of the docs, and build their site"
	@echo "make docs-test        run all commands of the docs as they are written (hours)"
	@echo "make vendor           bundle the libraries of the page of replay --browser (needs npm)"
	@echo "make wheel            build the sdist and wheel twice, compare them, and test the wheel without extras"
	@echo "make clean            remove the environments and everything that was built"

demo: $(VENV)/.demo
	@PATH="$(abspath $(BIN)):$$PATH" sh examples/demo.sh demo
	@printf '%s\n' "To use mcaprl yourself:" \
	  "  . $(BIN)/activate" \
	  "  mcaprl info demo/data" \
	  "  mcaprl replay demo/replay.mcap     # live, in Foxglove" \
	  "Next: docs/tutorial.md, and docs/howto/environment.md for your environment."

test: $(VENV)/.dev $(VENV)/.lerobot $(VENV)/.s3 $(VENV)/.rivals tests/node/node_modules
	OMP_NUM_THREADS=1 $(BIN)/pytest -n 2 --dist loadfile --no-loadscope-reorder $(QUICK)

core: $(VENV)/.core
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -q -m core tests

# The environment is new each time, and constraints.txt does not apply.
newest:
	$(PYTHON) -m venv --clear $(NEWEST)
	$(NEWEST)/bin/python -m pip install -qq --disable-pip-version-check --upgrade 'pip>=25.1'
	$(NEWEST)/bin/python -m pip install -qq --disable-pip-version-check -e '.[$(EXTRAS)]' --group dev
	$(NEWEST)/bin/python -m pip freeze --exclude-editable > $(NEWEST)/versions.txt
	OMP_NUM_THREADS=1 $(NEWEST)/bin/python -m pytest -q -m "not slow and not long" $(NEWEST_TESTS) \
	  || { echo "the versions are in $(NEWEST)/versions.txt; compare them with constraints.txt"; exit 1; }

faults: $(VENV)/.dev
	rm -f $(VENV)/fault-figures
	MCAPRL_FAULTS=large MCAPRL_FAULT_FIGURES=$(VENV)/fault-figures OMP_NUM_THREADS=1 \
	  $(BIN)/pytest -q -s tests/recorder/repair/test_faults_*.py tests/test_faults_inputs.py tests/ray/test_record.py tests/online/test_kills.py
	$(BIN)/python -m tests.support.damage.fault_table $(VENV)/fault-figures docs/reliability.md

fuzz: $(VENV)/.fuzz
	OMP_NUM_THREADS=1 $(BIN)/python -m tests.support.damage.fuzz_reader $(VENV)/fuzz \
	  -max_total_time=600 -max_len=60000 -timeout=20 -rss_limit_mb=2048

sanitize: $(VENV)/.dev
	CFLAGS="-fsanitize=address,undefined -fno-sanitize-recover" $(PIP) --no-deps -e .
	LD_PRELOAD="$$(cc -print-file-name=libasan.so) $$(cc -print-file-name=libubsan.so)" ASAN_OPTIONS=detect_leaks=0 \
	  OMP_NUM_THREADS=1 $(BIN)/pytest -q tests/recorder/columns; code=$$?; $(PIP) --no-deps -e . && exit $$code

check: $(VENV)/.dev
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/codespell
	$(BIN)/mypy
	$(BIN)/lint-imports
	$(BIN)/python .ci/ratchets.py

bench: $(BENCH)/.ready
	OMP_NUM_THREADS=1 $(BENCH)/bin/python -m benchmarks.run

bench-learning: $(VENV)/.rivals
	OMP_NUM_THREADS=1 $(VENV)/rivals/bin/python -m benchmarks.speed.learning
	OMP_NUM_THREADS=1 $(VENV)/rivals/bin/python -m benchmarks.studies.off_policy
	OMP_NUM_THREADS=1 $(VENV)/rivals/bin/python -m benchmarks.studies.cartpole_grid $(VENV)/cartpole

suite: $(VENV)/.rivals
	OMP_NUM_THREADS=1 $(VENV)/rivals/bin/python -m benchmarks.suite

sim-grid: $(VENV)/.dev
	OMP_NUM_THREADS=1 $(BIN)/python -m benchmarks.studies.sim_grid $(VENV)/sim-grid

docs: $(VENV)/.dev
	$(BIN)/python docs/generate.py
	$(BIN)/sphinx-build -q -W --keep-going -b html docs build/site
	@echo "wrote the site: build/site/index.html"

docs-test: $(VENV)/.dev tests/node/node_modules
	OMP_NUM_THREADS=1 $(BIN)/pytest -m slow tests/docs

vendor:
	cd recorder/viewer/page/vendor && npm ci --silent --no-audit --no-fund && npm run --silent build

wheel: $(VENV)/.dev tests/node/node_modules
	PYTHON="$(BIN)/python" sh .ci/check-wheel

clean:
	rm -rf $(VENV) $(BENCH) $(NEWEST) build dist demo *.egg-info tests/node/node_modules recorder/viewer/page/vendor/node_modules

$(VENV)/bin/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' \
	  || { echo "mcaprl needs Python 3.11 or later; set PYTHON=... to one"; exit 1; }
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install -qq --disable-pip-version-check --upgrade 'pip>=25.1'

# Modules are compiled when they are imported, which takes less time than compiling all of them.
$(VENV)/.demo: $(SETTINGS) | $(VENV)/bin/python
	@echo "installing into $(VENV): PyTorch, Numba and others, about 1.7 GB"
	@rm -f $@
	@{ $(BIN)/python -m pip install --disable-pip-version-check --no-compile -c constraints.txt \
	  -e '.[sims,offline,report,foxglove]' && touch $@; } \
	  | sed -n 's/^Collecting \([[:alnum:]_.-]*\).*/  \1/p; s/^Installing collected.*/  .../p'
	@test -f $@

# rliable's bootstrap, which the tests do not use, requires a version of arch that breaks with pandas 3.
$(VENV)/.dev: $(SETTINGS) | $(VENV)/bin/python
	@echo "installing into $(VENV): the package with its extras and the tools of the tests, about 3.3 GB, some minutes"
	$(PIP) -e '.[$(EXTRAS)]' --group dev
	$(PIP) --no-deps rliable
	@touch $@

$(VENV)/.core: $(SETTINGS) | $(VENV)/bin/python
	@echo "installing into $(VENV): PyTorch, Numba and others, about 1.7 GB, some minutes"
	$(PIP) -e '.[sims,offline]' pytest hypothesis
	@touch $@

# The libraries that the benchmarks compare with.
$(BENCH)/.ready: $(SETTINGS)
	@echo "installing into $(BENCH)"
	$(PYTHON) -m venv $(BENCH)
	$(BENCH)/bin/python -m pip install -qq --disable-pip-version-check --upgrade 'pip>=25.1'
	$(BENCH)/bin/python -m pip install -qq --disable-pip-version-check -c constraints.txt \
	  -e '.[sims,offline,online,report,video,bags,tables,interop,fast]' --group bench
	@touch $@

# d3rlpy requires an older gymnasium, and metaworld an older MuJoCo, but they run with those of
# constraints.txt and rivals.txt; so do SCOPE-RL, MinAtar and OGBench without dependencies
# that they need for other things.
$(VENV)/.rivals: $(SETTINGS) benchmarks/rivals.txt | $(VENV)/bin/python
	@echo "installing into $(VENV)/rivals: d3rlpy and SCOPE-RL with PyTorch, about 1.9 GB"
	$(BIN)/python -m venv $(VENV)/rivals
	$(VENV)/rivals/bin/python -m pip install -qq -c constraints.txt -e '.[sims,offline,online]'
	$(VENV)/rivals/bin/python -m pip install -qq -c constraints.txt -r benchmarks/rivals.txt
	$(VENV)/rivals/bin/python -m pip install -qq --no-deps d3rlpy==2.8.1 scope-rl==0.2.1 \
	  MinAtar==1.0.15 metaworld==3.1.1 ogbench==1.2.2
	@touch $@

# LeRobot, which the tests run in a separate environment: it requires older versions of PyTorch, NumPy
# and pandas than constraints.txt has. It runs with those of tests/lerobot.txt, without its pins.
$(VENV)/.lerobot: tests/lerobot.txt | $(VENV)/bin/python
	@echo "installing into $(VENV)/lerobot: LeRobot with PyTorch, about 1.6 GB"
	$(BIN)/python -m venv $(VENV)/lerobot
	$(VENV)/lerobot/bin/python -m pip install -qq -r tests/lerobot.txt
	$(VENV)/lerobot/bin/python -m pip install -qq --no-deps lerobot==0.4.4 torchvision==0.28.0
	@touch $@

# An S3 server, which requires an older python-dateutil than constraints.txt has.
$(VENV)/.s3: tests/s3.txt | $(VENV)/bin/python
	@echo "installing into $(VENV)/s3: an S3 server, about 0.5 GB"
	$(BIN)/python -m venv $(VENV)/s3
	$(VENV)/s3/bin/python -m pip install -qq -r tests/s3.txt -e '.[remote]'
	@touch $@

$(VENV)/.fuzz: $(VENV)/.dev
	$(PIP) --group fuzz
	@touch $@

# Node's MCAP libraries read the logs in tests; without npm those tests are skipped.
tests/node/node_modules: tests/node/package-lock.json
	@if command -v npm >/dev/null; then cd tests/node && npm ci --silent --no-audit --no-fund; \
	  else echo "npm is not installed: tests with Node's readers will be skipped"; fi
	@if [ -d $@ ]; then touch $@; fi
