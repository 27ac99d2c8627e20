# Everything a newcomer needs. `make demo` and `make test` are the two that matter.
# Each target sets up .venv by itself; it is made anew when pyproject.toml changes.

SHELL := /bin/bash
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
PROGRAM := $(VENV)/.program
STAMP := $(VENV)/.installed
ARAVIS := $(VENV)/.aravis
PYLON := $(VENV)/.pylon
STANDA := $(VENV)/.standa
# what the bench compares with: extras of pyproject.toml, each in .venv-<extra>
PEERS := bench bench-aldic
PEER_STAMPS := $(PEERS:%=.venv-%/.installed)
ARGS ?=
# containers often set it: each of some hundred processes, a virtual machine's too, would compile every module anew
unexport PYTHONDONTWRITEBYTECODE
# test files side by side, a process each: one more than there are cores, since devices make tests wait; more than four
# only compile the same kernels again
WORKERS ?= $(shell n=$$(nproc 2>/dev/null || echo 1); echo $$((n > 3 ? 4 : n + 1)))

.PHONY: fuzzreaders help release wheel demo quick test test-deep serve check check-page kernels bench format accuracy coverage fuzz load years soak problems docs torture stops powerloss livebench clusterbench pagespeed pagepictures same newest constraints clean

help:
	@echo "make demo    start the service on the simulated paper rig and run the plate experiment over HTTP"
	@echo "make quick   the tests that need no service and no device: minutes"
	@echo "make test    the whole behaviour at normal depth (WORKERS=1: one file at a time)"
	@echo "make test-deep  the long forms: fuzzing, kills, load, Monte Carlo at full depth"
	@echo "make serve   start the service on the simulated paper rig (ARGS='--config FILE --port N')"
	@echo "make check   lint, format check, types, import walls, docstrings, plain English; lint and types of the page's scripts"
	@echo "make bench   time everything on this machine, beside pyvale and al-dic-3d, and write docs/explanation/performance.md and its tables (ARGS=--quick: a few minutes)"
	@echo "make clusterbench  a long test on one and two workers, and on 64 simulated ones; writes docs/explanation/cluster.md (ARGS='--steps N')"
	@echo "make load    ten minutes of captures, readers, slow streams, analyses and stops; writes docs/explanation/reliability.md (ARGS='--minutes N')"
	@echo "make torture  kill the service 1,000 times at work, look each time that nothing is lost, write docs/explanation/reliability.md (ARGS='--kills N')"
	@echo "make stops   time stops beside 3,000 requests of any content, under load, and after 50 deaths of each process; write docs/explanation/reliability.md"
	@echo "make same BASE=<commit>   compare the results of this checkout with those of another commit, bit for bit"
	@echo "make powerloss  open 100,000 states in which a lost power may leave the data folder, write docs/explanation/reliability.md (ARGS='--states N')"
	@echo "make years   cost of a start and of answers over the size of the data folder; writes docs/explanation/years.md (ARGS='--sizes TESTS/STEPS ...')"
	@echo "make soak    an hour of captures, measurement, exports and page: does anything grow? (ARGS='--minutes N --write')"
	@echo "make fuzz    schema fuzzing of the whole API on a simulated rig (ARGS='--each N --seed S --only OPERATION')"
	@echo "make fuzzreaders  coverage-guided fuzzing of each reader of foreign files, a process each (ARGS='--executions N --reader NAME')"
	@echo "make wheel   build the wheel into dist/, with its bill of materials (CycloneDX) inside and beside"
	@echo "make release  everything that is published, into dist/: wheel, source, bill of materials, changes, citation, container file; tried in a fresh environment"
	@echo "make newest  the tests of make quick with the newest of every package, beyond the upper bounds"
	@echo "make constraints  write constraints.txt: the tested versions, with checksums, for a release"
	@echo "make docs    build the site into build/site, offline, and check every link in it"
	@echo "make problems  write server/static/problems.json, the list of errors, after a change of one"
	@echo "make pagespeed  measure the page in Chromium: first paint, live views, a field of 100,000 points; writes docs/explanation/page_speed.md"
	@echo "make accuracy   measure the figures of docs/explanation/accuracy.md and its tables again (about twenty minutes)"
	@echo "make coverage   replicates of the whole chain against its uncertainty: hours, goes on where it was; writes docs/explanation/accuracy/tables/coverage.csv (ARGS='--threads N --replicates N --others N --strata WORD' or --page)"

$(PROGRAM): pyproject.toml
	@command -v $(PYTHON) >/dev/null || { echo "stereorig needs Python 3.11 or newer. Install it: apt-get install python3 python3-venv"; exit 1; }
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { echo "stereorig needs Python 3.11 or newer; '$(PYTHON)' is $$($(PYTHON) -V 2>&1). Name another: make PYTHON=python3.12 ..."; exit 1; }
	@$(PYTHON) -c 'import venv, ensurepip' 2>/dev/null || { echo "Python's venv module is missing. Install it: apt-get install python3-venv"; exit 1; }
	@rm -rf $(VENV)
	@echo "Setting up $(VENV) (once) ..."
	@$(PYTHON) -m venv $(VENV)
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check -e . || { echo "pip could not install the packages of pyproject.toml; its message is above."; rm -rf $(VENV); exit 1; }
	@touch $@

# needs headers and a compiler, so it is not part of what everybody must have
$(ARAVIS): $(PROGRAM)
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check -e '.[aravis]' >$(VENV)/aravis.log 2>&1 \
		|| echo "No Aravis cameras here: PyGObject could not be built. For them: apt-get install gir1.2-aravis-0.8 aravis-tools libgirepository1.0-dev libcairo2-dev pkg-config gcc python3-dev, then make clean."
	@touch $@

# 90 MB and for few processors, so it is not part of what everybody must have either
$(PYLON): $(PROGRAM)
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check -e '.[pylon]' >$(VENV)/pylon.log 2>&1 \
		|| echo "No Basler cameras through pylon here: pip found no pypylon for this machine (.venv/pylon.log)."
	@touch $@

$(STANDA): $(PROGRAM)
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check -e '.[standa]' >$(VENV)/standa.log 2>&1 \
		|| echo "No Standa stages here: pip found no libximc for this machine (.venv/standa.log)."
	@touch $@

$(STAMP): $(PROGRAM) $(ARAVIS) $(PYLON) $(STANDA)
	@echo "Adding what the tests and checks need (once) ..."
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check -e '.[dev,docs]' || { echo "pip could not install the packages of pyproject.toml; its message is above."; exit 1; }
	@touch $@

demo: $(PROGRAM)
	$(BIN)/stereorig demo $(ARGS)

# Compiled once, side by side, where several workers would each compile the same kernels; nothing to do while no source is newer
KERNELS := $(VENV)/.kernels
$(KERNELS): $(STAMP) $(shell find core sim server/compute tests/support -name '*.py')
	@echo "Compiling kernels (once) ..."
	@$(BIN)/python -m tests.support.kernels
	@touch $@

# a worker for each core is enough: threads of the linear algebra that wait for a core spin on it
PYTEST = OPENBLAS_NUM_THREADS=1 $(BIN)/python -m pytest -n $(WORKERS) --dist loadfile --no-loadscope-reorder

kernels: $(KERNELS)

quick: $(KERNELS)
	$(PYTEST) -m 'not deep and not devices' tests/unit tests/contract $(ARGS)

# A test that fails beside others runs again, alone, at most twice: it names a defect only if it fails there, too. pytest ends
# with 1 if tests failed. build/tests.xml keeps each test's duration
ALONE = $(BIN)/python -m pytest --last-failed --last-failed-no-failures=none
test: $(KERNELS)
	@$(PYTEST) --junitxml=build/tests.xml $(ARGS); ended=$$?; \
	for time in first second; do \
		[ $$ended = 1 ] || break; \
		echo "Running what failed once more, alone ..."; $(ALONE) $(ARGS); ended=$$?; \
	done; exit $$ended

test-deep: $(KERNELS)
	$(PYTEST) -m deep $(ARGS)

serve: $(PROGRAM) $(ARAVIS)
	$(BIN)/stereorig serve $(ARGS)

check: $(STAMP)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports
	$(BIN)/python -m numpydoc lint $$(git ls-files 'core/*.py' 'drivers/*.py' 'sim/*.py')
	$(BIN)/python -m tests.support.plain_english

# The page runs as it lies in server/static; Node is for its check alone. Without Node that is said, and fails in CI only.
PAGE := tests/page/node_modules/.installed
$(PAGE): tests/page/package.json
	@echo "Setting up tests/page/node_modules (once) ..."
	@npm install --prefix tests/page --no-package-lock --no-audit --no-fund --loglevel=error
	@touch $@

check: check-page
check-page: $(STAMP) $(if $(shell command -v npm),$(PAGE))
	@$(BIN)/python -m tests.support.api_description
	@command -v npm >/dev/null || { echo "The page's scripts are not checked: Node is missing. Install it: apt-get install nodejs npm"; [ "$$CI" != true ]; exit $$?; }; \
		npm run --prefix tests/page --silent check

# Each peer has its own environment, since its pins clash with ours. Without it the rest is measured all the same.
$(PEER_STAMPS): .venv-%/.installed: pyproject.toml | $(STAMP)
	@rm -rf $(@D)
	@echo "Setting up $(@D) (once) ..."
	@$(PYTHON) -m venv $(@D)
	@$(BIN)/python -c 'import sys, tomllib; print(*tomllib.load(open("pyproject.toml", "rb"))["project"]["optional-dependencies"][sys.argv[1]], sep="\n")' $* > $(@D)/requirements.txt
	@$(@D)/bin/python -m pip install --quiet --disable-pip-version-check -r $(@D)/requirements.txt && touch $@ \
		|| { echo "pip could not install the peer of $(@D); its message is above. The bench goes on without it."; rm -rf $(@D); }

bench: $(STAMP) $(PEER_STAMPS)
	$(BIN)/python -m tests.bench.speed.bench $(ARGS)

# a live measurement's latency, ten minutes; ARGS="--minutes 1" for less
livebench: $(STAMP)
	$(BIN)/python -m tests.bench.live.live --page $(ARGS)

clusterbench: $(STAMP)
	$(BIN)/python -m tests.bench.cluster.bench $(ARGS)

accuracy: $(STAMP)
	$(BIN)/python -m tests.bench.accuracy.accuracy $(ARGS)

# with its bill of materials inside and beside
wheel: $(STAMP)
	$(BIN)/python -m pip wheel --quiet --disable-pip-version-check --no-deps -w dist .
	$(BIN)/python -m tests.bench.documents.bill_of_materials dist/stereorig-*.whl

release: $(STAMP)
	$(BIN)/python -m tests.bench.documents.release

coverage: $(STAMP)
	$(BIN)/python -m tests.bench.coverage.coverage $(ARGS)

load: $(STAMP)
	$(BIN)/python -m tests.bench.reliability.load --page $(ARGS)

years: $(STAMP)
	$(BIN)/python -m tests.bench.years.measure --page $(ARGS)

soak: $(STAMP)
	$(BIN)/python -m tests.bench.years.soak $(ARGS)

fuzz: $(STAMP)
	$(BIN)/python -m tests.support.api_fuzz $(ARGS)

fuzzreaders: $(STAMP)
	$(BIN)/python -m tests.fuzz.readers $(ARGS)

problems: $(STAMP)
	$(BIN)/python -m tests.bench.documents.problem_list

# the site needs the program, whose lists it shows, and four packages
SITE := $(VENV)/.site
$(SITE): $(PROGRAM)
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check -e '.[docs]' || { echo "pip could not install the packages of pyproject.toml; its message is above."; exit 1; }
	@touch $@

SPHINX = $(BIN)/python -m sphinx -n -W --keep-going -q -d build/doctrees
docs: $(SITE)
	$(SPHINX) -b html docs build/site
	@echo "build/site/index.html"

format: $(STAMP)
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

powerloss: $(STAMP)
	$(BIN)/python -m tests.bench.reliability.power_loss --write $(ARGS)

stops: $(STAMP)
	$(BIN)/python -m tests.bench.reliability.stop_beside --page $(ARGS)

torture: $(STAMP)
	$(BIN)/python -m tests.bench.reliability.torture --write $(ARGS)

pagespeed: $(STAMP)
	$(BIN)/python -m tests.bench.page.speed $(ARGS)

pagepictures: $(STAMP)
	$(BIN)/python -m tests.bench.page.pictures $(ARGS)

same: $(STAMP)
	$(BIN)/python -m tests.bench.same $(BASE)

# the newest of everything, beyond the upper bounds too, in an environment of its own. Called by hand, not by CI: no commit is
# to blame for what others publish
NEWEST := .venv-newest
newest:
	@rm -rf $(NEWEST) && $(PYTHON) -m venv $(NEWEST)
	@$(PYTHON) tests/bench/documents/constraints.py --unbounded > $(NEWEST)/asked.txt
	@$(NEWEST)/bin/python -m pip install --quiet --disable-pip-version-check --upgrade -r $(NEWEST)/asked.txt
	@$(NEWEST)/bin/python -m pip install --quiet --disable-pip-version-check --no-deps -e .
	@echo "Newer than constraints.txt:"; $(NEWEST)/bin/python -m tests.bench.documents.constraints --differences
	$(NEWEST)/bin/python -m tests.support.kernels
	$(MAKE) BIN=$(NEWEST)/bin KERNELS= quick

constraints: $(STAMP)
	$(BIN)/python -m tests.bench.documents.constraints

clean:
	rm -rf $(VENV) $(NEWEST) $(PEERS:%=.venv-%) tests/page/node_modules build dist *.egg-info .mypy_cache .ruff_cache .pytest_cache .import_linter_cache .cache
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
