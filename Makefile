# Two commands on a fresh machine: `make demo` and `make test`. Both make .venv and install what they need.
PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
SUPPLY := .venv-supply
PIP := $(BIN)/python -m pip --disable-pip-version-check install --quiet --constraint constraints.txt
SOURCES := pyproject.toml constraints.txt $(wildcard worker/worlds/car_racing/native/*)

# Every process of every test would compile our modules again where an environment forbids the cache.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: demo test test-doom pythons test-newest short slow setup check long proof box2d-py simulate mutants chaos weekend fuzz sanitize bundle worker-size \
  stranger reproduce reproduce-evolution messages keyed lock audit sbom structure words site reference clean

demo: $(VENV)/.demo $(if $(filter takecover,$(WORLD)),$(VENV)/.demo-doom)  ## evolve a controller here (WORLD=takecover: there), judge it, plot it, record it
	$(BIN)/dreamfleet demo $(if $(WORLD),--world $(WORLD)) $(ARGS)

test: $(VENV)/.dev  ## every test that ends within two seconds: five and a half minutes
	$(BIN)/pytest -m "not slow and not long" --numprocesses 3 --dist worksteal $(ARGS)

slow: $(VENV)/.dev  ## those that take longer, each under two minutes; what lands has passed both
	$(BIN)/pytest -m "slow and not long" --numprocesses 3 --dist worksteal $(ARGS)

$(VENV)/.doom: $(VENV)/.dev
	$(PIP) --editable '.[doom]'
	touch $@

test-doom: $(VENV)/.doom  ## the tests that play Doom; they need the package vizdoom, 184 MB
	$(BIN)/pytest -m "needs_doom and not long" --numprocesses 2 --dist worksteal $(ARGS)

pythons: $(VENV)/.dev  ## the wheel without Box2D, swig and pygame on PYTHONS, by default those that are here: the same bits on all
	$(BIN)/python deploy/check_wheel.py $(or $(PYTHONS),$(shell deploy/newest_python.sh all))

NEWEST ?= $(shell deploy/newest_python.sh)
test-newest:  ## a short part of the tests, those without torch, on the newest Python that is here, in its own environment
	@if [ -z "$(NEWEST)" ]; then echo "neither Python 3.13 nor 3.12 is here: nothing was run"; \
	else $(MAKE) short VENV=.venv-newest PYTHON=$(NEWEST); fi
# What another version of Python breaks first: syntax, dataclasses, threads and processes, pickles, warnings, one run.
SHORT := tests/common/files tests/common/host tests/common/protocol tests/common/schema tests/common/cli/test_config.py \
  tests/coordinator/settings tests/coordinator/storage tests/coordinator/run tests/experiments/test_minimise.py \
  tests/worker/service tests/worker/scoring tests/test_structure.py
WITHOUT_TORCH := --deselect tests/worker/service/test_slot_pool.py::test_a_torch_device_that_is_not_there_ends_the_worker_at_once

short: $(VENV)/.short  # of `test-newest`
	$(BIN)/pytest -m "not slow and not long" --numprocesses 3 --dist worksteal $(SHORT) $(WITHOUT_TORCH) $(ARGS)

$(VENV)/.short: $(VENV)/bin/python $(SOURCES)
	$(PIP) --editable '.[short-tests]'
	touch $@

setup: $(VENV)/.dev  ## everything that development needs

$(VENV)/bin/python:
	$(PYTHON) -m venv $(VENV)

$(VENV)/.demo: $(VENV)/bin/python $(SOURCES)
	$(PIP) --editable '.[worker,views,dashboard]'
	touch $@

$(VENV)/.demo-doom: $(VENV)/.demo
	$(PIP) --editable '.[worker,views,dashboard,doom]'
	touch $@

$(VENV)/.dev: $(VENV)/bin/python $(SOURCES)
	$(PIP) --editable '.[dev]'
	touch $@ $(VENV)/.demo $(VENV)/.docs

$(VENV)/.docs: $(VENV)/bin/python $(SOURCES)
	$(PIP) --editable '.[docs]'
	touch $@

check: $(VENV)/.dev  ## style, types, import contracts, spelling, the site's links, and a wheel that installs into an empty environment
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports
	$(BIN)/codespell
	$(BIN)/python deploy/words.py --spelling
	$(MAKE) site
	$(BIN)/python deploy/check_wheel.py

long: $(VENV)/.dev  ## proofs that take half an hour: five run seeds of the demo improve
	$(BIN)/pytest -m long --timeout 3600 $(ARGS)

proof: $(VENV)/.dev  ## CarRacing against gymnasium: STEPS (3,000,000), a track and 100 pictures for each 1,000 steps: hours
	PROOF_STEPS=$(or $(STEPS),3000000) $(BIN)/pytest -m long --timeout 40000 tests/worker/worlds/car_racing/test_race.py $(ARGS)

box2d-py: $(VENV)/bin/python  ## the same library from its source archive instead of the wheel; needs a C++ compiler
	$(PYTHON) -m venv .venv-box2d-py
	.venv-box2d-py/bin/python -m pip install --quiet --constraint constraints.txt setuptools swig
	.venv-box2d-py/bin/python -m pip install --quiet --constraint constraints.txt --editable '.[dev]'
	.venv-box2d-py/bin/python -m pip uninstall --quiet --yes box2d
	PATH=$(CURDIR)/.venv-box2d-py/bin:$$PATH .venv-box2d-py/bin/python -m pip install --quiet --no-build-isolation box2d-py==2.3.8
	.venv-box2d-py/bin/pytest -m "not long" $(ARGS)

simulate: $(VENV)/.dev  ## SCHEDULES seeded schedules of faults against the pure parts, by a virtual clock: 100,000 take ten minutes
	$(BIN)/python -m tests.simulation --schedules $(or $(SCHEDULES),100000) --seed $(or $(SEED),1) --jobs $(or $(JOBS),2)

mutants: $(VENV)/.dev  ## COUNT small faults planted in the engine, drawn by SEED: which do its tests notice? REPLAY=FILE compares
	$(BIN)/python -m tests.mutation --count $(or $(COUNT),300) --seed $(or $(SEED),1) $(if $(REPLAY),--replay $(REPLAY)) $(ARGS)

weekend: $(VENV)/.dev  ## a run that nobody watches, whose episodes fail, under FAULTS outages, kills, clock steps and full disks
	$(BIN)/python -m tests.chaos.chaos --stage failing --faults $(or $(FAULTS),100) --seed $(or $(SEED),1) $(ARGS)

chaos: $(VENV)/.dev  ## a fleet under FAULTS seeded faults gives the bits of one that nobody disturbs
	$(BIN)/python -m tests.chaos.chaos --faults $(or $(FAULTS),200) --seed $(or $(SEED),7) $(ARGS)

fuzz: $(VENV)/.dev  ## CALLS command lines with odd values, drawn by SEED, of every verb or of those that begin with VERB
	$(BIN)/python -m tests.fuzz --calls $(or $(CALLS),2000) --seed $(or $(SEED),1) $(if $(VERB),--verb $(VERB)) $(ARGS)

sanitize: $(VENV)/.dev  ## 200,000 steps of the native CarRacing under AddressSanitizer: ten minutes
	mkdir -p build
	cc -std=c11 -O1 -g -fsanitize=address,undefined -fno-sanitize-recover=all -ffp-contract=off -fwrapv -shared -fPIC \
	  -I$$($(BIN)/python -c "import sysconfig; print(sysconfig.get_path('include'))") \
	  worker/worlds/car_racing/native/*.c -lm -o build/sanitized.so
	LD_PRELOAD=$$(cc -print-file-name=libasan.so) ASAN_OPTIONS=detect_leaks=0 SDL_VIDEODRIVER=dummy \
	  $(BIN)/python deploy/sanitize.py build/sanitized.so $(or $(STEPS),200000)

bundle: $(VENV)/.dev  ## a world model like the shipped one, from nothing: an hour of two cores; ROUNDS=1: 20 minutes
	$(BIN)/dreamfleet iterate --data data/tiny --rounds $(or $(ROUNDS),2) --more-drives 580 --own-drives 0 \
	  --run-flags "--generations 32 --collect-every 2 --collect-episodes 5" $(ARGS)

reproduce: $(VENV)/.demo-doom  ## drive the shipped controllers again and compare with docs/lab/results; REPRODUCE=NAME: one of them
	$(BIN)/dreamfleet verify report $(if $(REPRODUCE),docs/lab/results/$(REPRODUCE).json,$(sort $(wildcard docs/lab/results/*.json))) $(ARGS)

reproduce-evolution: $(VENV)/.demo  ## the run again that REPRODUCE=NAME came from (tiny), by its receipt; the same bits
	$(BIN)/python deploy/reproduce_evolution.py $(or $(REPRODUCE),tiny) $(ARGS)

stranger:  ## both commands as a stranger runs them: a fresh clone of what is committed, no settings, an empty home
	deploy/stranger.sh

worker-size: $(VENV)/bin/python  ## what a worker's environment weighs
	$(BIN)/python deploy/worker_size.py

$(SUPPLY)/.done:
	$(PYTHON) -m venv $(SUPPLY)
	$(SUPPLY)/bin/python -m pip --disable-pip-version-check install --quiet cyclonedx-bom pip-audit pip-tools
	touch $@

lock: $(SUPPLY)/.done  ## deploy/*.lock: exact versions and hashes of what stands in the images
	$(SUPPLY)/bin/python deploy/lock.py

audit: $(SUPPLY)/.done  ## known vulnerabilities of the oldest allowed and of all locked versions, by a dated copy and by the package index
	$(SUPPLY)/bin/python deploy/audit.py

sbom: $(SUPPLY)/.done  ## build/worker.cdx.json: what a worker's environment is made of, as CycloneDX
	rm -rf build/locked && mkdir -p build
	$(PYTHON) -m venv --without-pip build/locked
	$(SUPPLY)/bin/python -m pip --disable-pip-version-check --python build/locked/bin/python install --quiet --require-hashes --requirement deploy/worker.lock
	$(SUPPLY)/bin/python -m pip --disable-pip-version-check --python build/locked/bin/python install --quiet --no-deps .
	$(SUPPLY)/bin/cyclonedx-py environment --pyproject pyproject.toml --output-reproducible --validate \
	  --output-file build/worker.cdx.json build/locked/bin/python

messages:  ## tests/golden/messages.txt: every message of the product, as it stands in the code
	@mkdir -p build tests/golden
	$(PYTHON) deploy/messages.py > build/messages.txt && mv build/messages.txt tests/golden/messages.txt

keyed: $(VENV)/.dev  ## the tests with a key in place of each message: one that fails reads a sentence. ARGS='tests/common'
	PYTHONPATH=$(CURDIR)/tests/support/keyed $(BIN)/pytest -m "not slow and not long and not wording" --numprocesses 3 --dist worksteal $(ARGS)

core: $(VENV)/.dev  ## the core's tests in a copy without any add-on
	$(PYTHON) deploy/core.py $(ARGS)

structure:  ## figures of the structure: rooms, floors, imports, wording; FILE=PATH: what a change of that file may touch
	$(PYTHON) deploy/structure.py $(FILE) $(ARGS)

words:  ## words a page, sentences of more than 30 words, words to avoid; PAGES='README.md printed': which ones
	@$(PYTHON) deploy/words.py $(PAGES) $(ARGS)

site: $(VENV)/.docs  ## build/site: README and all documents as a site that needs no network; every link is checked
	rm -rf build/pages && mkdir -p build/pages/deploy
	cp -r README.md CONTRIBUTING.md CHANGELOG.md docs build/pages
	cp deploy/*.md build/pages/deploy
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet
	@echo "build/site/index.html; with search: $(PYTHON) -m http.server --directory build/site"

reference: $(VENV)/.dev  ## docs/reference/verbs.md and settings.md from the parsers
	$(BIN)/python deploy/reference.py

clean:
	rm -rf $(VENV) $(SUPPLY) .venv-box2d-py .venv-newest build dist *.egg-info
