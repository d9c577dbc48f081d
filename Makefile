# make smoke | test | long | changed | nightly | environments | processors | tutorials | faults | cluster | side-by-side | fuzz | gate | wild | reference | reference-check | lint | bench | ratios | docs | clean. Everything is installed in .venv, pinned by constraints.txt.
PYTHON ?= python3
VENV ?= .venv
# Test processes; 0 runs all tests in one process, which is easier to debug.
JOBS ?= 2

BIN := $(VENV)/bin
STAMP := $(VENV)/.sysid_bench_installed
DOCS_STAMP := $(VENV)/.sysid_bench_docs_installed
CLUSTER_STAMP := $(VENV)/.sysid_bench_cluster_installed
# One BLAS thread a process: test processes and workers fill the cores already.
ONE_THREAD := OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 MKL_NUM_THREADS=1
# Many processes start: a fifth to a third faster where Python may write its compiled files.
COMPILED := PYTHONDONTWRITEBYTECODE=
TESTS := -n $(JOBS) --dist worksteal --durations=10 --benchmark-disable \
	--ignore=tests/benchmarks --ignore=tests/faults --ignore=tests/cluster

GATED := smoke terminal agnostic

.PHONY: changed nightly nightly-versions nightly-extras environments wheel smoke test long processors tutorials faults cluster side-by-side fuzz gate gate-models wild reference reference-check lint bench ratios docs clean install

install: $(STAMP)

$(STAMP): pyproject.toml constraints.txt .cmake/CMakeLists.txt sysid_bench/vectors.h sysid_bench/regressors/kernel.c \
		sysid_bench/simulation/steps.c sysid_bench/simulation/lanes.c \
		sysid_bench/identification/simulation_based/filters.c
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install -c constraints.txt -e ".[dev]"
	touch $@

smoke: $(STAMP)
	$(BIN)/sysid-bench run suites/smoke.toml
	@echo "The report is $(CURDIR)/reports/smoke/report.html"

test: $(STAMP)
	$(COMPILED) $(ONE_THREAD) $(BIN)/python -m pytest -m "not long and not tutorial" $(TESTS)

# All commands of README.md, docs/ and CONTRIBUTING.md as printed, whole suites, and runs that are killed.
long: $(STAMP)
	$(COMPILED) $(ONE_THREAD) $(BIN)/python -m pytest -m long $(TESTS)

# The parts that the changes since BASE need (.ci/parts.py), one after the other.
BASE ?=
changed:
	@parts=$$($(PYTHON) .ci/parts.py $(BASE)) && echo "changed files need: $$parts" && $(MAKE) $$parts

# What .ci/run leaves out: the tests with the lowest and the newest versions, with the NumPy kernel, with each extra left
# out, then the tutorials. Each in an environment of its own below NIGHTLY, one at a time: hours.
NIGHTLY ?= /tmp/sysid-bench-nightly
nightly:
	@echo "nightly: tests with lowest and newest versions, NumPy kernel, each extra left out; tutorials"
	$(MAKE) nightly-versions nightly-extras tutorials
	SYSID_BENCH_KERNEL=numpy PYTEST_ADDOPTS=--hypothesis-profile=nightly $(MAKE) test

nightly-versions:
	$(PYTHON) .ci/environments.py tests --folder $(NIGHTLY) lowest newest

nightly-extras:
	$(PYTHON) .ci/environments.py tests --folder $(NIGHTLY) without-pin without-robots without-rerun without-parquet \
		without-logs without-peers

# Resolves the environments of docs/where-it-runs.md, installs those that install here, and prints the table.
environments:
	$(PYTHON) .ci/environments.py try --folder $(NIGHTLY)

# A wheel for this platform, in dist/.
wheel: $(STAMP)
	$(BIN)/python -m pip wheel --no-deps -w dist .

# `make test` and the kept rows of reports with the kernels of other processors (OpenBLAS, NumPy, compiled): before a
# release. PROCESSORS=haswell runs one of them.
PROCESSORS := haswell sandybridge skylakex numpy
processors: $(PROCESSORS:%=processor-%)

processor-%: $(STAMP)
	$(COMPILED) $(ONE_THREAD) $(BIN)/python -m tests.processors $* -m "not long and not tutorial" $(TESTS)
	$(COMPILED) $(ONE_THREAD) $(BIN)/python -m tests.processors $* -m long $(TESTS) tests/test_reference_reports.py

# All commands of the tutorials as printed: by hand, before a release; they repeat much of `make long`.
tutorials: $(STAMP)
	$(COMPILED) $(ONE_THREAD) $(BIN)/python -m pytest -m tutorial $(TESTS)

# Faulty plug-ins, orders and changed sources, in real runs: hangs are waited for, six at a time.
faults: $(STAMP)
	$(COMPILED) $(ONE_THREAD) $(BIN)/python -m pytest -n 6 --dist worksteal --durations=5 tests/faults

# Runs on Dask workers and in jobs of SLURM, whose parts are killed.
cluster: $(CLUSTER_STAMP)
	$(COMPILED) $(ONE_THREAD) $(BIN)/python -m pytest -n 2 --dist worksteal --durations=5 tests/cluster

$(CLUSTER_STAMP): $(STAMP)
	$(BIN)/python -m pip install -q -c constraints.txt -e ".[cluster]"
	touch $@

# Damaged inputs of every kind that is read, N of each, from case FIRST on.
N ?= 200
FIRST ?= 0
fuzz: $(STAMP)
	$(ONE_THREAD) $(BIN)/python -m tests.faults.fuzz --count $(N) --first $(FIRST)

# Suites against their stored values; 'baseline update' takes over what changed on purpose.
gate: $(STAMP) $(GATED:%=gate-%) gate-models

gate-%: $(STAMP)
	rm -rf reports/gate/$*
	$(BIN)/sysid-bench run suites/$*.toml -o reports/gate/$* --baseline tests/baselines/$*.json > reports/gate-$*.txt \
		|| { cat reports/gate-$*.txt; exit 1; }
	@tail -n 1 reports/gate-$*.txt

# All models of example-robot-data, which is installed anyway; '--save FILE' takes over what changed on purpose.
gate-models: $(STAMP)
	rm -rf reports/gate/models
	$(BIN)/sysid-bench survey example-robot-data --samples 4 --no-engines -o reports/gate/models \
		--baseline tests/baselines/models.json > reports/gate-models.txt || { cat reports/gate-models.txt; exit 1; }
	@head -n 1 reports/gate-models.txt

# About 800 public models, 1.2 GB of packages: before a release, not in .ci/run.
wild: $(STAMP)
	$(BIN)/sysid-bench fetch wild
	$(BIN)/sysid-bench survey wild -o reports/wild --baseline tests/baselines/wild.json
	cp reports/wild/report.md reports/reference/wild.md

# Pages of reports/reference from the commands that they name: those that are older than their code (hours), or
# REPORTS="smoke arms" (minutes). Runs stay
# below reports/, where the same command resumes them; OPTIONS=--stored draws pages from the rows that are there.
reference: $(STAMP)
	$(ONE_THREAD) $(BIN)/python -m reports.make.reference_reports $(OPTIONS) $(REPORTS)

# Texts, origins, numbers in sentences and later changes of reports/reference; `OPTIONS=--declare` writes what changed.
reference-check: $(STAMP)
	$(BIN)/python -m reports.make.reference_check $(OPTIONS)

lint: $(STAMP)
	$(BIN)/ruff check sysid_bench tests docs reports/make .ci
	$(BIN)/ruff format --check sysid_bench tests docs reports/make .ci
	$(BIN)/mypy

bench: $(STAMP)
	$(ONE_THREAD) $(BIN)/python -m pytest tests/benchmarks --benchmark-only

# Speed ratios against tests/baselines/ratios.json, in a minute or two; OPTIONS=--keep replaces those of this processor.
ratios: $(STAMP)
	$(COMPILED) $(ONE_THREAD) $(BIN)/python -m tests.benchmarks.ratios $(OPTIONS)

# The site, in site/: open site/index.html. Warnings are errors; links and requests are checked.
docs: $(DOCS_STAMP)
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict --quiet
	$(BIN)/python -m docs.check_site site

$(DOCS_STAMP): $(STAMP)
	$(BIN)/python -m pip install -q -c constraints.txt "sysid-bench[docs]"
	touch $@

# What .ci/run does after the tests, two parts at a time, since clusters mostly wait. All is installed before.
side-by-side: $(CLUSTER_STAMP) $(DOCS_STAMP)
	$(MAKE) -j 2 --output-sync=target cluster gate docs lint reference-check

clean:
	find .cmake -mindepth 1 ! -name CMakeLists.txt ! -name .gitignore -delete
	rm -f sysid_bench/regressors/libregressor.* sysid_bench/simulation/libsteps.* sysid_bench/simulation/liblanes.* \
		sysid_bench/identification/simulation_based/libfilters.*
	rm -rf build dist site .pytest_cache .mypy_cache .ruff_cache .hypothesis .benchmarks $(STAMP) $(DOCS_STAMP) $(CLUSTER_STAMP)
	find sysid_bench tests -name __pycache__ -type d -prune -exec rm -rf {} +
