#!/usr/bin/env bash
# Builds the Python module and runs its tests: with the newest NumPy beside zarr-python, xarray and dask, and with NumPy 1.26 alone.
# Everything lies in target/python; PYTHON is the interpreter, FEATURES=opencv builds the module with OpenCV.
set -euo pipefail
cd "$(dirname "$0")/.."
python=${PYTHON:-python3}
mkdir -p "${CARGO_TARGET_DIR:-target}"
target=$(cd "${CARGO_TARGET_DIR:-target}" && pwd)
work=$target/python

environment() { # name, packages
    [ -x "$work/$1/bin/python" ] || "$python" -m venv "$work/$1"
    "$work/$1/bin/python" -m pip install --quiet --disable-pip-version-check "${@:2}"
}

environment new "maturin>=1.9,<2" "numpy>=2" pytest safetensors "mitsuba>=3.9" moderngl "xarray>=2024.10" "zarr>=3" dask \
    "distributed>=2024.10" jsonschema
rm -rf "$work/wheels"
CARGO_TARGET_DIR=$target "$work/new/bin/maturin" build --quiet --release --locked --auditwheel skip --features "${FEATURES:-}" \
    --manifest-path python/Cargo.toml --out "$work/wheels"
wheel=("$work"/wheels/acquire-*.whl)
runs=(new)
# NumPy 1.26 has no wheels for later Pythons.
if "$python" -c 'import sys; sys.exit(sys.version_info >= (3, 13))'; then
    environment old "numpy==1.26.*" pytest safetensors
    runs+=(old)
fi
for name in "${runs[@]}"; do
    "$work/$name/bin/python" -m pip install --quiet --disable-pip-version-check --force-reinstall --no-deps "${wheel[0]}"
    ACQUIRE=$target/release/acquire "$work/$name/bin/python" -m pytest -q python
done
