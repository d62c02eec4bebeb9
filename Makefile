# make demo: set-up, release build, and the whole way on a simulated capture.
# make test: set-up, then the tests; CI=true adds the slow ones, formatting, lints and documentation.
# SLOW=1 adds the slow tests only.
# make python: the Python module's tests, in virtual environments under target/python; part of make test when CI=true.
# make cloud: matrices in object stores, against a local S3 server in a virtual environment; part of make test when CI=true.
# make figures: Figures 1 to 3 of docs/rendering.md, in results/figures; FIGURES="--figure 3 --points 32 --width 160 --spp 64": only that one, quicker.
# Needs what make python needs, LLVM 16 or later (Debian: libllvm19), and from PyPI Mitsuba, scikit-image, xatlas, flip-evaluator and Pillow.
# make mutants: small faults that no test notices (docs/testing.md); some hours, for a night. MUTANTS=src/evaluate: only there; STEP=4: every fourth.

CARGO ?= cargo
DEMO  ?= results/demo
TARGET = $(or $(CARGO_TARGET_DIR),target)
ACQUIRE = $(TARGET)/release/acquire

# With the Python module and object stores in CI only: the module's dependencies would build much of the program's a second
# time, and object stores have 120 crates of their own.
WORKSPACE = --workspace $(if $(filter true,$(CI)),--features acquire/cloud,--exclude acquire-python)
comma := ,

.PHONY: demo test check build python cloud figures mutants setup

demo: build
	rm -rf $(DEMO)
	mkdir -p $(DEMO)
	$(ACQUIRE) simulate $(DEMO)/capture --material chessboard-4x4 --grid 26x22 --window 25x21 --lit-pitch-mm 1.5 --seed 1
	$(ACQUIRE) run $(DEMO)/capture --out $(DEMO)/results

# One profile for program and tests, so that OpenCV's bindings are built once.
test: setup
	$(if $(filter true,$(CI)),scripts/setup.sh python && scripts/test_cloud.sh install)
	ACQUIRE_S3_SERVER=$(abspath $(TARGET))/python/s3/bin/moto_server \
	$(CARGO) test --release --locked $(WORKSPACE) $(if $(filter true,$(CI))$(SLOW),-- --include-ignored)
	$(if $(filter true,$(CI)),$(MAKE) check python)

# After all other tests with their features: the library is built then, and the program too.
python: $(if $(filter true,$(CI)),setup,build)
	@scripts/setup.sh python
	$(if $(filter true,$(CI)),FEATURES=opencv$(comma)acquire/cloud) scripts/test_python.sh

cloud: setup
	@scripts/setup.sh python
	scripts/test_cloud.sh

figures:
	@scripts/setup.sh python
	scripts/python_figures.sh $(FIGURES)

check: setup
	$(CARGO) fmt --all --check
	$(CARGO) clippy --release --locked $(WORKSPACE) --all-targets -- -D warnings
	$(CARGO) clippy --release --locked -p acquire-python -- -D warnings # and of the library without OpenCV
	RUSTDOCFLAGS="-D warnings" $(CARGO) doc --release --locked $(WORKSPACE) --no-deps
	scripts/figures.py --list >/dev/null # the descriptions of the documentation's tables can be read

build: setup
	$(CARGO) build --release --locked

MUTANTS ?= $(addprefix src/,evaluate factor transport response radiance registration) crates/acquire-material
STEP    ?= 1

mutants: setup
	scripts/mutants.py $(MUTANTS) --step $(STEP)

setup:
	@scripts/setup.sh
