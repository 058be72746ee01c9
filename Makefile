# `make demo` and `make test` are all a fresh clone needs; both are idempotent.
PYTHON ?= $(shell command -v python3.11 || echo python3)
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed

.PHONY: setup demo same test test-slow bench faults soak table1 check wheels format golden config docs clean

setup: $(STAMP)  ## compile the numeric loops, half a minute; without it the first run does
	$(BIN)/stream-dmr setup

demo: $(STAMP)  ## the main job on the bundled scene, lengths beside the truth
	$(BIN)/stream-dmr demo

# One worker more than two cores: for a quarter of the time tests wait for others.
test: $(STAMP)  ## the tests of a few minutes; their processes would all compile at once
	$(BIN)/stream-dmr setup
	$(BIN)/pytest -n 3 --dist worksteal

test-slow: $(STAMP)  ## the long ones, and those on material outside the repository
	$(BIN)/pip install --quiet --constraint constraints.txt --editable '.[ray]'
	$(BIN)/pytest -m "slow or scenes"
	$(BIN)/pytest -n 3 --dist worksteal --hypothesis-profile new

bench: $(STAMP)  ## the fit beside other renderers, and the chain: docs/research/fit-speed.md, six minutes
	$(BIN)/python -m benchmarks.fit_speed

table1: $(STAMP)  ## Table 1 of the paper on simulated fish: docs/research/table1.md; FISH=60 for a quick look
	$(BIN)/python -m benchmarks.table1 $(if $(FISH),--fish $(FISH)) \
		$(if $(ROWS),--rows $(ROWS)) $(if $(AGAIN),--again)

faults: $(STAMP)  ## all that goes wrong at sea: docs/research/crashes.md, two hours; FAULTS="--only clock"
	$(BIN)/python -m benchmarks.reliability.faults $(FAULTS)

soak: $(STAMP)  ## an hour of a looped live stream; SOAK="--minutes 5" for less
	$(BIN)/python -m benchmarks.reliability.soak $(SOAK)

check: $(STAMP)  ## style and types
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/pyright

EXTRAS := alerts foxglove h264 meshes plots ray
PLATFORMS := x86_64-manylinux_2_28 aarch64-manylinux_2_28

# pip judges markers by the machine it runs on, uv by the one it is told, and it downloads no wheel.
wheels: $(STAMP)  ## whether all that users install has wheels for x86-64 and ARM64, and what lacks
	$(BIN)/pip install --quiet --constraint constraints.txt uv
	@lacks=0; for platform in $(PLATFORMS); do for python in 3.11 3.12 3.13; do \
		$(BIN)/uv pip compile --quiet --only-binary :all: --constraint constraints.txt \
			--python-platform $$platform --python-version $$python \
			$(EXTRAS:%=--extra %) pyproject.toml > /dev/null \
			&& echo "$$platform, Python $$python: wheels of all" \
			|| { echo "$$platform, Python $$python: lacks what is said above"; lacks=1; }; \
	done; done; exit $$lacks

format: $(STAMP)
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

golden: $(STAMP)  ## recordings/golden anew, after saying what moved
	$(BIN)/python recordings/make_golden.py

same: $(STAMP)  ## six runs by this checkout and by BASE, every output compared; ten minutes
	$(BIN)/python -m tests.corpus --base $(or $(BASE),main)

config: $(STAMP)  ## config.toml anew from the settings classes
	$(BIN)/python -m stream_dmr.pipeline.config > config.toml.new
	mv config.toml.new config.toml

docs: $(STAMP)  ## the plan of the imports, the tables of settings, reasons and files, anew from the code
	$(BIN)/python -m tests.support.pages

# The stamp comes last, so that an interrupted installation is taken up again.
$(STAMP): pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV) || { echo "needs the module venv: apt install python3-venv"; exit 1; }
	$(BIN)/pip install --quiet --constraint constraints.txt --editable '.[dev]'
	touch $@

clean:
	rm -rf $(VENV)
