#!/usr/bin/env bash
# Builds the Python module and runs its tests: with the newest NumPy beside zarr-python, xarray and dask, and with NumPy 1.26 alone.
# Everything lies in target/python; PYTHON is the interpreter, FEATURES=opencv builds the module with OpenCV.
set -euo pipefail
cd "$(dirname "$0")/.."
. scripts/python_env.sh

environment new "maturin>=1.9,<2" "numpy>=2" pytest safetensors "mitsuba>=3.9" moderngl "xarray>=2024.10" "zarr>=3" dask \
    "distributed>=2024.10" jsonschema "OpenEXR>=3.3"
build_wheel new
runs=(new)
# NumPy 1.26 has no wheels for later Pythons.
if "$python" -c 'import sys; sys.exit(sys.version_info >= (3, 13))'; then
    environment old "numpy==1.26.*" pytest safetensors
    runs+=(old)
fi
for name in "${runs[@]}"; do
    install_wheel "$name"
    ACQUIRE=$target/release/acquire "$work/$name/bin/python" -m pytest -q python
done
