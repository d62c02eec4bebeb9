# make demo: set-up, release build, and the whole way on a simulated capture.
# make test: set-up, then the tests; CI=true adds the slow ones, formatting, lints and documentation.
# SLOW=1 adds the slow tests only.
# make python: the Python module's tests, in virtual environments under target/python; part of make test when CI=true.
# make mutants: small faults that no test notices (docs/testing.md); some hours, for a night. MUTANTS=src/evaluate: only there; STEP=4: every fourth.

CARGO ?= cargo
DEMO  ?= results/demo
TARGET = $(or $(CARGO_TARGET_DIR),target)
ACQUIRE = $(TARGET)/release/acquire

.PHONY: demo test check build python mutants setup

demo: build
	rm -rf $(DEMO)
	mkdir -p $(DEMO)
	$(ACQUIRE) simulate $(DEMO)/capture --material chessboard-4x4 --grid 26x22 --window 25x21 --lit-pitch-mm 1.5 --seed 1
	$(ACQUIRE) run $(DEMO)/capture --out $(DEMO)/results

# One profile for program and tests, so that OpenCV's bindings are built once.
test: setup
	$(CARGO) test --release --locked --workspace $(if $(filter true,$(CI))$(SLOW),-- --include-ignored)
	$(if $(filter true,$(CI)),$(MAKE) check python)

# Without OpenCV, a workspace of its own.
python: build
	@scripts/setup.sh python
	scripts/test_python.sh
	$(if $(filter true,$(CI)),cd python && $(CARGO) fmt --check)

check: setup
	$(CARGO) fmt --check
	$(CARGO) clippy --release --locked --workspace --all-targets -- -D warnings
	RUSTDOCFLAGS="-D warnings" $(CARGO) doc --release --locked --workspace --no-deps

build: setup
	$(CARGO) build --release --locked

MUTANTS ?= $(addprefix src/,evaluate factor transport response radiance registration) crates/acquire-material
STEP    ?= 1

mutants: setup
	scripts/mutants.py $(MUTANTS) --step $(STEP)

setup:
	@scripts/setup.sh
