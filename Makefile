# make demo    set up and run the daemon for 20 s on the emulated bench
# make hidden-effect   hide a physical effect in the emulated bench and find its name
# make test    set up, check the style, lint, type-check and run every test but the long ones; CI runs this
# Variables: PYTHON (interpreter for the virtual environment)

VENV := .venv
BIN := $(VENV)/bin
RELEASE := build/release
PIP := $(BIN)/python -m pip --disable-pip-version-check --quiet

.DEFAULT_GOAL := help
.DELETE_ON_ERROR:
.PHONY: help setup demo hidden-effect docs deb release test test-here test-sysid test-hidden test-guest test-native test-sanitized test-all mutants bench bench-kernel kernel-with-vcan fuzz soak soak-exact lint style types format clean

help: ## this list
	@sed -n 's/^\([a-z-]*\):[^#]*## /\1\t/p' $(MAKEFILE_LIST) | expand -t 14

setup: $(VENV)/.installed-dev ## .venv with the development tools

demo: $(VENV)/.installed ## 20 s of jtqd on the emulated bench
	$(BIN)/jtqd --bus sim --duration 20

hidden-effect: $(VENV)/.installed-analysis ## hide an effect in the emulated bench and find it, without a bus: hidden/
	$(BIN)/python -m examples.hidden_effect --effect torque_constant --bus none --out hidden --picture hidden/before_after.png

test: style ## everything but the tests marked campaign
	@# Before the guest looks at this tree: what is written below it while it runs, it sees in part. pytest compiles its test_*.py.
	$(BIN)/python -m compileall -q -j 0 -x '/test_[^/]*$$' daemon drivers estimator models sim_can sysid tests tools validation
	@$(MAKE) --no-print-directory -k -j2 --output-sync=target test-native test-guest test-hidden test-here test-sysid types

# Two lanes at once, in this order. The native one sleeps for most of its time, and beside it runs one that only takes the
# turns that nobody else wants: beside two, processes came late. The bench kernel keeps a time of its own.
BEHIND := nice -n 10
LEFT_OVER := $(if $(shell chrt --idle 0 echo yes 2>/dev/null),chrt --idle 0,nice -n 19)
ONE_THREAD := OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1
# What takes the processor for about as long as the rest of sysid, and as all else.
HIDDEN := tests/validation tests/examples tests/sysid/batch tests/sysid/evaluate tests/sysid/fit tests/sysid/train
HERE := not (campaign or socketcan or boots or native)
SLOWEST := --durations=20 --durations-min=2
# $(call MARKED,MARK|MARK): the files with a test so marked; a lane reads no others.
MARKED = $(shell grep -rlE --include='test_*.py' 'mark\.($(1))\b' tests | sort)

test-here:
	$(ONE_THREAD) $(BEHIND) $(BIN)/python -m pytest $(SLOWEST) -m "$(HERE)" $(HIDDEN:%=--ignore=%) --ignore=tests/sysid

test-sysid:
	$(ONE_THREAD) $(LEFT_OVER) $(BIN)/python -m pytest $(SLOWEST) -m "$(HERE)" $(HIDDEN:%=--ignore=%) tests/sysid

test-hidden:
	$(ONE_THREAD) $(LEFT_OVER) $(BIN)/python -m pytest $(SLOWEST) -m "$(HERE)" $(HIDDEN)

# It builds its kernel itself: a lane that waits for another target would lose its turn to the next one.
test-guest: $(VENV)/.installed-test
	$(LEFT_OVER) $(BIN)/python -m jtqd.sim_can.bench_kernel build --unless-vcan
	$(LEFT_OVER) $(BIN)/python -m pytest $(SLOWEST) -m "(socketcan or boots) and not campaign" $(call MARKED,socketcan|boots)

# Processes at the pace of this machine's clock, whose inputs come in time, or that are judged by how quick or how often
# something is: beside them runs only what takes turns that are left over.
test-native:
	$(BIN)/python -m pytest $(SLOWEST) -m "native and not (campaign or socketcan or boots)" $(call MARKED,native)

test-all: lint kernel-with-vcan ## everything: also the long tests, two releases that must be equal, the mutants, the sanitizers
	$(BIN)/python -m pytest
	$(MAKE) --no-print-directory test-sanitized

test-sanitized: $(VENV)/.installed-test ## compiled code with bounds checks, AddressSanitizer and UBSan, a million frames
	$(BIN)/python -m tests.slow.sanitized

mutants: $(VENV)/.installed-test ## each small change of the code that decides on a number that is sent must fail a test
	$(BIN)/python -m tests.slow.mutants

lint: style types ## ruff and mypy

style: $(VENV)/.installed-test
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .

types: $(VENV)/.installed-test
	$(BIN)/mypy

format: $(VENV)/.installed-dev ## rewrite the sources in the project's style
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

bench: $(VENV)/.installed-dev ## measure the loop: ratios from one run
	$(BIN)/python -m tests.benchmarks

fuzz: $(VENV)/.installed-test ## a million frames by both paths, 300 damaged files of each kind, a storm
	$(BIN)/python -m tests.slow.fuzz frames --count 1000000
	$(BIN)/python -m tests.slow.fuzz service --count 1000000
	$(BIN)/python -m tests.slow.fuzz files --count 300
	$(BIN)/python -m tests.slow.fuzz storm

soak: $(VENV)/.installed-dev ## jtqd for 30 minutes with faults drawn at random
	$(BIN)/python -m tests.slow.soak --minutes 30

soak-exact: $(VENV)/.installed-dev ## the same in the bench kernel: as much guest time as an hour gives
	$(BIN)/python -m tests.slow.soak --exact --minutes 1440 --wall 3600

kernel-with-vcan: $(VENV)/.installed-test
	$(BIN)/python -m jtqd.sim_can.bench_kernel build --unless-vcan

bench-kernel: $(VENV)/.installed ## build the kernel with SocketCAN into the cache, once
	$(BIN)/python -m jtqd.sim_can.bench_kernel build

docs: $(VENV)/.created ## the documentation as a site: build/site/index.html
	$(PIP) install 'mkdocs-material>=9.5,<10'
	$(BIN)/mkdocs build --strict --quiet

deb: $(VENV)/.installed ## Debian package into dist/: jtqd in /opt/jtqd, units, user, configuration
	$(BIN)/python tools/deb.py --out dist

release: $(RELEASE)/.installed ## wheel, sdist, Debian package, SBOM and SHA256SUMS of the commit into dist/
	@[ -z "$$(git status --porcelain)" ] || echo "make release: NOT in the release, as not committed: $$(git status --short | tr '\n' ' ')" >&2
	$(RELEASE)/bin/python -m tools.release

clean: ## remove what make made here; the cached bench kernel stays
	rm -rf $(VENV) build dist src/*.egg-info .mypy_cache .ruff_cache .pytest_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
	find src daemon drivers estimator models sim_can sysid -name '*.so' -delete

# Stages of one environment; each stamp is renewed when pyproject.toml changes.
$(VENV)/.created:
	@.ci/venv $(VENV)
	@touch $@

# Of the tools of a release: no development tool gets in, and their versions are fixed.
$(RELEASE)/.installed: pyproject.toml tools/release.txt
	@.ci/venv $(RELEASE)
	@.ci/requirements build release >$(RELEASE)/packages.txt
	@$(RELEASE)/bin/python -m pip --disable-pip-version-check --quiet install -c tools/release.txt pip -r $(RELEASE)/packages.txt || { \
	echo "make release: NO RELEASE WITHOUT ITS SBOM: cyclonedx-bom and the fixed build tools are not installed here. With PyPI or a mirror" >&2; \
	echo "(PIP_INDEX_URL), or with wheels in a directory (PIP_NO_INDEX=1 PIP_FIND_LINKS=DIR):" >&2; \
	echo "    $(RELEASE)/bin/python -m pip install -c tools/release.txt pip -r $(RELEASE)/packages.txt" >&2; exit 1; }
	@touch $@

# Every compiled module and what it is made of: a change installs, and so compiles, again.
COMPILED := $(shell find daemon drivers estimator models sim_can sysid -name '*.pyx' -o -name '*.pxd')

# Each has what those above it have, and says so by their stamps.
SOURCES := pyproject.toml setup.py $(COMPILED) $(VENV)/.created

$(VENV)/.installed: $(SOURCES)
	@echo "compiling jtqd, installing it into $(VENV)"
	@.ci/install $(VENV)
	@touch $@

$(VENV)/.installed-analysis: $(SOURCES)
	@echo "compiling jtqd, installing it into $(VENV) with scipy and matplotlib"
	@.ci/install $(VENV) analysis
	@touch $(VENV)/.installed $@

$(VENV)/.installed-dev: $(SOURCES)
	@echo "compiling jtqd, installing it into $(VENV) with the development tools"
	@.ci/install $(VENV) analysis dev
	@touch $(VENV)/.installed $(VENV)/.installed-analysis $@

$(VENV)/.installed-test: $(SOURCES)
	@echo "compiling jtqd, installing it into $(VENV) with the development tools and torch for training"
	@.ci/browser & .ci/install $(VENV) analysis dev train && wait
	@touch $(VENV)/.installed $(VENV)/.installed-analysis $(VENV)/.installed-dev $@
