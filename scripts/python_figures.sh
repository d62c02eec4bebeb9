#!/usr/bin/env bash
# Makes the figures of docs/rendering.md with the Python module of this checkout; arguments are those of `python -m acquire.figures`.
# Everything lies in target/python, pictures in results/figures.
set -euo pipefail
cd "$(dirname "$0")/.."
. scripts/python_env.sh

environment new "maturin>=1.9,<2" "numpy>=2" "mitsuba>=3.9" "scikit-image>=0.22" "xatlas>=0.0.9" "flip-evaluator>=1.5" "pillow>=10.1"
build_wheel new
install_wheel new
exec "$work/new/bin/python" -m acquire.figures "$@"
